"""What came of the checks of a run's own job."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter
from typing import TYPE_CHECKING

from rsltrace.errors import RsltraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace_viewer.model.run import Run

if TYPE_CHECKING:
    from rsltrace.checks.evaluate import CheckResult

_STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class Checks:
    """The checks that were violated, how many passed, and why none could be held against the run,
    if so."""

    violated: tuple[CheckResult, ...] = ()
    passed: int = 0
    error: str = ""


def read_checks(run: Run) -> Iterator[Checks]:
    """Hold the checks of a run's job against it: yield now and then, and in the end what came of
    them; nothing if the job has none, or the run is not finished. Functions are not called, since
    a trace may come from anybody."""
    if not run.trace.complete or "checks" not in run.trace.job_text:
        return
    from rsltrace.checks.evaluate import PASSED, VIOLATED, evaluating, job_of_checks

    try:
        last = perf_counter()
        for results in evaluating(run.trace, job_of_checks(run.trace)):
            if results:
                violated = tuple(one for one in results if one.verdict == VIOLATED)
                yield Checks(violated, sum(one.verdict == PASSED for one in results))
            elif perf_counter() - last > _STEP_S:
                yield Checks()
                last = perf_counter()
    except RsltraceError as error:
        yield Checks(error=str(error).splitlines()[0])
