"""``vary:`` of a job: settings that have other values in each run of an exploration."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart, after_fields
from rsltrace.job.values.checks import attach, check, check_names, one_of, whole
from rsltrace.job.values.problem import JobProblem, describe
from rsltrace.job.values.times import parse_time

METHODS = ("grid", "random", "latin_hypercube")
SAMPLES_MAX = 10_000_000
_STEP = r"""(?:"[^"]*"|'[^']*'|[^.=\s'"\[\]]+)"""
_PATH = re.compile(rf"{_STEP}(?:(?:\.{_STEP})|\[[0-9]+\])*")
_NEVER = ("vary", "base", "include", "checks", "metrics")


def check_setting(name: str) -> None:
    """Raise ``ValueError`` unless ``name`` is a key of a job as ``--set`` takes it."""
    if not _PATH.fullmatch(name):
        raise ValueError(
            f"{describe(name)} is no key of a job: write it as for --set, as in "
            "nodes.ekf.parameters.rate or delay.default"
        )
    first = re.split(r"[.\[]", name)[0]
    if first in _NEVER:
        raise ValueError(f"{first}: is the same in every run")


def is_time(value: object) -> bool:
    """Whether a bound is a time with a unit."""
    return isinstance(value, str)


def _bound(value: object) -> float | str:
    """Check a number, or a time with a unit."""
    if isinstance(value, str):
        parse_time(value)
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise JobProblem(f"expected a number, or a time with a unit (5ms), got {describe(value)}")
    if not abs(value) < float("inf"):
        raise JobProblem(f"expected a finite number, got {value}")
    return value


_bound_schema = {"anyOf": [{"type": "number"}, {"type": "string"}]}


def _pair(value: object) -> tuple[float | str, float | str]:
    if not isinstance(value, (list, tuple)) or len(value) != 2:
        raise JobProblem(f"expected two values, as in [0.5, 2.0], got {describe(value)}")
    first, second = map(_bound, value)
    if is_time(first) != is_time(second):
        raise JobProblem("give two numbers, or two times with units")
    return first, second


attach(_pair, schema={"type": "array", "items": _bound_schema, "minItems": 2, "maxItems": 2})
Pair = Annotated["tuple[float | str, float | str] | None", check(_pair, optional=True)]


def _values(value: object) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)) or not value:
        raise JobProblem(f"expected a list of values, got {describe(value)}")
    return tuple(value)


attach(_values, schema={"type": "array", "minItems": 1})


class SettingSpec(JobPart):
    """The values of one setting. Exactly one of ``values``, ``uniform``, ``log_uniform``,
    ``normal`` and ``integers``; a list alone is ``values``."""

    ONE_OF: ClassVar[tuple[str, ...]] = (
        "values",
        "uniform",
        "log_uniform",
        "normal",
        "integers",
    )

    values: Annotated[tuple[Any, ...] | None, check(_values, optional=True)] = Field(
        default=None,
        description="The values.",
        examples=[["slow", "fast"]],
    )
    uniform: Pair = Field(
        default=None,
        description="Uniform between two numbers or times.",
        examples=[[0.5, 2.0], ["1ms", "20ms"]],
    )
    log_uniform: Pair = Field(
        default=None,
        description="Uniform in the logarithm.",
        examples=[[0.001, 1.0]],
    )
    normal: Pair = Field(
        default=None,
        description="Normal: mean and standard deviation. Times are at least 0.",
        examples=[[1.0, 0.1]],
    )
    integers: Pair = Field(
        default=None, description="Integers from one to another.", examples=[[1, 10]]
    )
    steps: Annotated[int | None, check(whole(2, 100_000), optional=True)] = Field(
        default=None,
        description="Number of values in a grid of `uniform` or `log_uniform`.",
        examples=[5],
    )

    @property
    def kind(self) -> str:
        return next(kind for kind in self.ONE_OF if getattr(self, kind) is not None)

    @after_fields
    def _makes_sense(self) -> None:
        given = [kind for kind in self.ONE_OF if getattr(self, kind) is not None]
        if len(given) != 1:
            raise JobProblem(f"give one of {', '.join(self.ONE_OF)}, or a list of values")
        kind = given[0]
        if self.steps is not None and kind not in ("uniform", "log_uniform"):
            raise JobProblem(f"steps are for uniform and log_uniform, not for {kind}", ("steps",))
        if self.values is not None:
            return
        first, second = self.bounds
        if kind == "normal":
            if second <= 0:
                raise JobProblem("the standard deviation must be more than 0", (kind, 1))
        elif second <= first:
            raise JobProblem("the second value must be greater than the first", (kind, 1))
        if kind == "log_uniform" and first <= 0:
            raise JobProblem("must be more than 0", (kind, 0))
        if kind == "integers":
            pair = self.integers or ()
            if any(is_time(bound) or bound != int(bound) for bound in pair):
                raise JobProblem("expected two integers, as in [1, 10]", (kind,))

    @property
    def bounds(self) -> tuple[float, float]:
        """The two values of what is no list; times in nanoseconds."""
        first, second = (
            float(parse_time(bound)) if is_time(bound) else float(bound)
            for bound in getattr(self, self.kind)
        )
        return first, second

    @property
    def of_time(self) -> bool:
        """Whether the two values are times."""
        return self.values is None and is_time(getattr(self, self.kind)[0])


def _settings(values: object) -> object:
    if not isinstance(values, dict):
        raise JobProblem(f"expected a mapping of keys of the job to values, got {describe(values)}")
    check_names(values, check_setting)
    return {
        name: {"values": value} if isinstance(value, (list, tuple)) else value
        for name, value in values.items()
    }


class VarySpec(JobPart):
    """Settings that ``rsltrace explore --strategy vary`` changes."""

    MEANT: ClassVar[str] = "settings"

    settings: Annotated[
        dict[str, SettingSpec],
        check(_settings, names={"pattern": r"^\S.*$"}, value_shorthand="values"),
    ] = Field(
        description="By key, as for `--set`: a list of values, or a range.",
        examples=[
            {
                "nodes.ekf.parameters.rate": [10.0, 50.0],
                "delay.default": {"uniform": ["1ms", "20ms"]},
            }
        ],
    )
    method: Annotated[Literal["grid", "random", "latin_hypercube"], check(one_of(*METHODS))] = (
        Field(
            default="random",
            description="How values are combined; `latin_hypercube` needs SciPy.",
            examples=["latin_hypercube"],
        )
    )
    samples: Annotated[int | None, check(whole(1, SAMPLES_MAX), optional=True)] = Field(
        default=None,
        description="Number of combinations. Default: all of a grid, unlimited for `random`, 100 "
        "for `latin_hypercube`.",
        examples=[200],
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            settings: dict[str, Any],
            method: str = "random",
            samples: int | None = None,
        ) -> None: ...

    @after_fields
    def _goes_together(self) -> None:
        if not self.settings:
            raise JobProblem("nothing varies: name at least one key of the job", ("settings",))
        if self.method != "grid":
            return
        if self.samples is not None:
            raise JobProblem("a grid has as many combinations as it has", ("samples",))
        for name, spec in self.settings.items():
            if spec.kind in ("uniform", "log_uniform") and spec.steps is None:
                raise JobProblem("how many values? Give steps: 5", ("settings", name, spec.kind))
            if spec.kind == "normal":
                raise JobProblem(
                    "a grid has no normal distribution: give a list of values",
                    ("settings", name, spec.kind),
                )
