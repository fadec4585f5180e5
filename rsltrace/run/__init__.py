"""Run a job: from a Job to a trace and a result."""

from __future__ import annotations

from pathlib import Path

from rsltrace.job import Job
from rsltrace.run.process import RunCallbacks, preserved_process
from rsltrace.run.provenance import environment
from rsltrace.run.session import RunResult, RunSession
from rsltrace.run.simulation import Simulation

__all__ = ["RunCallbacks", "RunResult", "Simulation", "environment", "record", "run"]


def record(
    job: Job,
    output: str | Path | None,
    *,
    force: bool = False,
    echo: bool = False,
    replay: str | Path | None = None,
) -> RunResult:
    """Run a job and record it to ``output`` (None: run without recording).

    With ``force``, a trace that is there is replaced when the new one is whole. A run that does not
    come about (a constructor raises) leaves it, and its own trace beside it: see the result's path.
    ``echo`` prints the nodes' log records on stderr. ``replay`` is a trace of the same job: what
    its nodes got from outside (``guard:``, mode ``record``) is given to them again.

    :raises RunError: what went wrong in the run; the trace is complete up to there.
    :raises JobError, SetupError, BagError, OutputError: the run could not start or be written.
    """
    result = run(job, output, force=force, echo=echo, replay=replay)
    if result.error is not None:
        raise result.error
    return result


def run(
    job: Job,
    output: str | Path | None,
    *,
    force: bool = False,
    echo: bool = False,
    observer: RunCallbacks | None = None,
    replay: str | Path | None = None,
) -> RunResult:
    """Do ``record``, but return a failed run's error in the result instead of raising it."""
    path = None if output is None else Path(output)
    earlier = None if replay is None else Path(replay)
    with (
        preserved_process(),
        RunSession(job, path, force=force, echo=echo, observer=observer, replay=earlier) as session,
    ):
        session.begin()
        if not session.ended:
            session.go_on()
        return session.finish()
