"""Run one trial of a search: its trace, its checks and metrics, what is new in it."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from rsltrace.checks.evaluate import VIOLATED, CheckResult, evaluate_checks, load_function
from rsltrace.checks.metrics import evaluate_metrics
from rsltrace.errors import CheckError, DeadlockError, JobError, LivelockError, NodeError, RunError
from rsltrace.job import Job
from rsltrace.run.process import preserved_process, search_path
from rsltrace.run.session import RunResult, RunSession
from rsltrace.search.explore.steps import TrialObserver, behaviours_of, final_state_of
from rsltrace.search.explore.trial import (
    CHECK,
    DEADLOCK,
    ERROR,
    EXCEPTION,
    EXIT,
    LIVELOCK,
    UNFINISHED,
    Failure,
    JobSource,
    Trial,
    TrialResult,
)
from rsltrace.trace.model.texts import shortened
from rsltrace.trace.reader import Trace

_FRAME = re.compile(r'File "([^"\n]*)", line (\d+)')
_TEXT_MAX = 1000


@dataclass(frozen=True, slots=True)
class TrialOptions:
    """What a trial records.

    ``keep``: its trace even if nothing failed. ``strict``: a check that cannot be evaluated is an
    error, not a failure of the run. ``fork_ns``: up to which simulated time the run equals the
    plain one and may be forked from it (-1: not at all).
    """

    keep: bool = False
    behaviours: bool = False
    steps: bool = False
    strict: bool = False
    fork_ns: int = -1


def run_trial(
    source: JobSource, trial: Trial, trace: Path, wants: TrialOptions | None = None
) -> TrialResult:
    """Run a trial in this process; its trace stays at ``trace`` if it failed, or is wanted.

    For a process that runs one trial, as ``rsltrace record`` does. ``workers`` runs many.

    :raises JobError, SetupError, BagError, OutputError: the run could not start or be written.
    :raises CheckError: a check cannot be evaluated, and ``wants`` is strict.
    """
    wants = wants or TrialOptions()
    began = time.perf_counter()
    job = source.job(trial)
    with preserved_process(), RunSession(job, trace, force=True) as session:
        watch = TrialObserver(session, steps=wants.steps, fork_ns=wants.fork_ns)
        session.begin()
        if not session.ended:
            session.go_on()
        ran = session.finish()
    return result_of_run(job, trial, ran, watch, wants, began)


def result_of_run(
    job: Job,
    trial: Trial,
    ran: RunResult,
    watch: TrialObserver,
    wants: TrialOptions,
    began_s: float,
) -> TrialResult:
    """Return the result of a finished run. It began at ``began_s`` of ``time.perf_counter``. Its
    trace is deleted unless it failed, or is wanted."""
    assert ran.path is not None, "it has been recorded"
    with Trace.open(ran.path) as opened:
        failure = _failure(job, ran, opened, wants)
        metrics: dict[str, float] = {}
        if failure is None or failure.kind != ERROR:
            failure, metrics = _metrics(job, opened, failure, wants)
        found = TrialResult(
            trial,
            digest=ran.digest,
            events=ran.events,
            end_ns=ran.end_ns,
            choices=len(watch.order),
            entities=len(watch.entities),
            choices_before=watch.choices_before,
            failure=failure,
            metrics=metrics,
            final_state=final_state_of(opened),
            behaviours=behaviours_of(opened) if wants.behaviours else (),
            order=tuple(watch.order) if wants.behaviours else (),
            steps=watch.steps(opened) if wants.steps else (),
        )
    kept = wants.keep or failure is not None
    if not kept:
        ran.path.unlink(missing_ok=True)
    wall_s = time.perf_counter() - began_s
    return replace(found, trace=str(ran.path) if kept else None, wall_s=round(wall_s, 6))


def _failure(job: Job, ran: RunResult, trace: Trace, wants: TrialOptions) -> Failure | None:
    """Return the failure of a run, its own before those of checks."""
    if ran.error is not None:
        return _of_error(job, ran.error, trace)
    try:
        with search_path(job):
            checks = evaluate_checks(trace, job, load_function)
    except (CheckError, JobError) as error:
        if wants.strict:
            raise
        return _not_held(error)
    failed = min(_violated(checks), key=lambda one: _order(one.event), default=None)
    if failed is not None:
        return failed
    if ran.exit_code == 0:
        return None
    if ran.stop_reason.startswith("timeout"):
        return Failure(UNFINISHED, f"it did not end before its {ran.stop_reason}", "timeout")
    text = f"it ended with exit status {ran.exit_code}: {ran.stop_reason}"
    return Failure(EXIT, text, f"exit status {ran.exit_code}")


def _not_held(error: CheckError | JobError) -> Failure:
    """Return the failure of a run for which a check or metric cannot be evaluated."""
    text = str(error)
    return Failure(ERROR, shortened(text, _TEXT_MAX), f"a check: {text.splitlines()[0]}")


def _metrics(
    job: Job, trace: Trace, failure: Failure | None, wants: TrialOptions
) -> tuple[Failure | None, dict[str, float]]:
    """Return the run's metrics that have a value, and its failure, which may be one of them."""
    if not job.metrics:
        return failure, {}
    try:
        with search_path(job):
            found = evaluate_metrics(trace, job, load_function)
    except (CheckError, JobError) as error:
        if wants.strict:
            raise
        return failure or _not_held(error), {}
    return failure, {one.name: one.value for one in found if one.value is not None}


def _violated(checks: list[CheckResult]) -> Iterator[Failure]:
    for one in checks:
        if one.verdict == VIOLATED:
            first = one.violations[0]
            text = f"{one.name}: {first.text}" if first.text else one.name
            yield Failure(CHECK, shortened(text, _TEXT_MAX), one.name, first.event)


def _order(event: int | None) -> tuple[bool, int]:
    return event is None, event or 0


def _of_error(job: Job, error: RunError, trace: Trace) -> Failure:
    ended = trace.ended_after
    event = ended - 1 if ended else None
    text = shortened(str(error), _TEXT_MAX)
    if isinstance(error, NodeError):
        kind = type(error.__cause__).__qualname__
        return Failure(EXCEPTION, text, f"{kind} at {_place(job, error)}", event)
    if isinstance(error, DeadlockError):
        return Failure(DEADLOCK, text, f"deadlock at {_last_line(job, str(error))}", event)
    if isinstance(error, LivelockError):
        return Failure(LIVELOCK, text, "livelock", event)
    return Failure(ERROR, text, f"{type(error).__name__}: {text.splitlines()[0]}", event)


def _place(job: Job, error: NodeError) -> str:
    """Return the innermost line of the user's code."""
    frames = _FRAME.findall(error.traceback_text)
    if not frames:
        return error.entity
    file, line = frames[-1]
    return f"{_relative(job, file)}:{line}"


def _last_line(job: Job, text: str) -> str:
    """Return the lines of code that a deadlock names."""
    places = re.findall(r"at (\S+):(\d+) in", text)
    return ", ".join(dict.fromkeys(f"{_relative(job, file)}:{line}" for file, line in places))


def _relative(job: Job, file: str) -> str:
    """Return a path relative to the job's folder."""
    if not os.path.isabs(file):
        return file
    return os.path.relpath(file, job.base_dir)
