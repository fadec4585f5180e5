"""The metrics of a job: one number each, from the trace of a finished run."""

from __future__ import annotations

import math
import numbers
from dataclasses import dataclass

from rsltrace.checks.conditions.run_expression import RunExpression
from rsltrace.checks.evaluate import LoadFunction
from rsltrace.errors import CheckError, ConditionError, JobError, RsltraceError
from rsltrace.job import Job, locate
from rsltrace.job.parts.check import MetricSpec
from rsltrace.job.values.checks import target_text
from rsltrace.trace.reader import Trace


@dataclass(frozen=True, slots=True)
class MetricResult:
    """What a metric is worth: None where it has no value, for the reason in ``note``."""

    name: str
    value: float | None
    unit: str = ""
    note: str = ""

    @property
    def text(self) -> str:
        """The value with its unit, for people."""
        if self.value is None:
            return "none"
        return f"{self.value:.6g}{f' {self.unit}' if self.unit else ''}"


def check_metrics(job: Job) -> None:
    """Raise JobError, with its line, at an expression that cannot be understood."""
    for name, spec in job.metrics.items():
        if spec.expression is not None:
            _expression(job, name, spec.expression)


def evaluate_metrics(
    trace: Trace, job: Job, load: LoadFunction | None = None
) -> list[MetricResult]:
    """Return what the metrics of ``job`` are worth for a trace, in their order.

    ``load`` gives the functions they name; without it, these have no value.

    :raises JobError: an expression cannot be understood.
    :raises CheckError: a function raised, or returned something else than a number.
    :raises TraceError: the trace is damaged.
    """
    return [_evaluated(trace, job, name, spec, load) for name, spec in job.metrics.items()]


def _evaluated(
    trace: Trace, job: Job, name: str, spec: MetricSpec, load: LoadFunction | None
) -> MetricResult:
    unit = spec.unit or ""
    if spec.expression is not None:
        expression = _expression(job, name, spec.expression)
        try:
            value = expression.value(trace)
        except ConditionError as error:
            return MetricResult(name, None, unit, error.message)
        return MetricResult(name, _number(value, f"metric {name}: {spec.expression}"), unit)
    assert spec.function is not None
    if load is None:
        why = "functions are called for a job's file, not for a trace's"
        return MetricResult(name, None, unit, why)
    called = f"metric {name}: {target_text(spec.function)}"
    try:
        value = load(spec.function)(trace)
    except RsltraceError:
        raise
    except Exception as error:
        raise CheckError(f"{called} raised {type(error).__name__}: {error}") from error
    if value is None:
        return MetricResult(name, None, unit, "the function says that there is none")
    return MetricResult(name, _number(value, called), unit)


def _expression(job: Job, name: str, text: str) -> RunExpression:
    try:
        return RunExpression(text)
    except ConditionError as error:
        where = locate(job, ("metrics", name))
        raise JobError(f"metric {name}: {error}", where=where) from None


def _number(value: object, said: str) -> float:
    """Return a value as a float; booleans count as 0 and 1.

    :raises CheckError: it is none.
    """
    value = value.item() if hasattr(value, "item") else value  # numpy's
    if isinstance(value, numbers.Real):
        try:
            return float(value)
        except OverflowError:
            return math.inf if str(value)[0] != "-" else -math.inf
    raise CheckError(f"{said} is a {type(value).__name__}, not a number")
