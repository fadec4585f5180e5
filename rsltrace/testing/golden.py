"""Golden traces: a run is right if it does what the run did that was checked in."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, ClassVar

from rsltrace.errors import OutputError, RsltraceError, TraceError
from rsltrace.trace.model.regular_file import not_replaceable, replacement_of

if TYPE_CHECKING:
    from rsltrace.diff.options import DiffOptions
    from rsltrace.job import Job
    from rsltrace.replay.one_node.result import NodeReplayResult
    from rsltrace.run import RunResult
    from rsltrace.search.history.run_record import RunRecord

UPDATE_HINT = "pytest --rsltrace-update accepts what it does now"


class GoldenSession:
    """What pytest was asked for, and what was done; the plugin sets and reads it."""

    update: bool = False
    history: str = ""
    written: ClassVar[list[Path]] = []


class GoldenMismatch(AssertionError):
    """A run does not do what its golden trace did; the message is the report of the diff."""


def run_job(
    job: Job | str | os.PathLike[str], tmp_path: str | os.PathLike[str], *, name: str = "run.mcap"
) -> RunResult:
    """Run a job (a ``Job``, or the path of a job file) and record it to ``tmp_path/name``.

    An existing trace of that name is overwritten. Raises what ``rsltrace.record`` raises: a
    RunError if the run itself went wrong, with the trace complete up to there.
    """
    from rsltrace.job import load_job
    from rsltrace.run import record

    loaded = load_job(Path(job)) if isinstance(job, (str, os.PathLike)) else job
    return record(loaded, Path(tmp_path, name), force=True)


def assert_matches_golden(
    job_or_result: Job | RunResult | str | os.PathLike[str],
    golden: str | os.PathLike[str],
    *,
    update: bool | None = None,
    options: DiffOptions | None = None,
) -> bool:
    """Assert that a run does the same as the golden trace.

    ``job_or_result`` is a job (or its file, which is then run), the result of ``run_job``, or the
    path of a trace (``.mcap``). With ``update`` (default: whether this is ``pytest
    --rsltrace-update``), the golden trace is written instead wherever it is missing or another
    one. ``options`` shape the report; no tolerance makes a run match, nor does a trace that is cut.
    Returns whether the golden trace was written.

    :raises GoldenMismatch: they diverge; the message is the report.
    :raises RsltraceError: there is nothing to compare: the run failed, a file is unreadable or
        cannot be written.
    """
    __tracebackhide__ = True
    with golden_run(golden, update=update) as run:
        return check_golden(job_or_result, Path(golden), run, update, options)


def golden_run(
    golden: str | os.PathLike[str], *, update: bool | None = None
) -> AbstractContextManager[RunRecord]:
    """Give the record of a run, which goes to the session's history unless the trace is updated."""
    from rsltrace.search.history.run_record import recorded

    place = "" if _is_update(update) else GoldenSession.history
    return recorded(place, "golden", Path(golden), lambda path: [str(path(os.fspath(golden)))])


def check_golden(
    job_or_result: Job | RunResult | str | os.PathLike[str],
    target: Path,
    run: RunRecord,
    update: bool | None,
    options: DiffOptions | None,
) -> bool:
    """Do what ``assert_matches_golden`` does, and set the result in the record of the run."""
    __tracebackhide__ = True
    path = _trace_of(job_or_result)
    if path is None:
        with TemporaryDirectory(prefix="rsltrace-golden-") as folder:
            result = run_job(job_or_result, folder)  # type: ignore[arg-type]
            return check_golden(result, target, run, update, options)
    if _is_update(update):
        written = _write(path, target)
        GoldenSession.written += [target] if written and update is None else []
        return written
    if not target.exists():
        raise TraceError(f"there is no golden trace {target}: pytest --rsltrace-update writes it")
    report = _report(target, path, run, options)
    if report is not None:
        raise GoldenMismatch(f"{report}\n{UPDATE_HINT}")
    return False


def _is_update(update: bool | None) -> bool:
    return GoldenSession.update if update is None else update


def _trace_of(given: Job | RunResult | str | os.PathLike[str]) -> Path | None:
    """Return the trace that is given, or None for a job."""
    if isinstance(given, (str, os.PathLike)):
        path = Path(given)
        return None if path.suffix in (".yaml", ".yml") else path
    from rsltrace.run import RunResult

    if not isinstance(given, RunResult):
        return None
    if given.path is None:
        raise TraceError("the run was not recorded, so there is nothing to compare: use run_job")
    return given.path


def _report(golden: Path, path: Path, run: RunRecord, options: DiffOptions | None) -> str | None:
    """Return what differs, or None if nothing does."""
    from rsltrace.diff.options import DiffOptions
    from rsltrace.diff.report import render
    from rsltrace.diff.traces.diff import diff_traces
    from rsltrace.trace.reader import Trace

    options = options or DiffOptions()
    with Trace.open(golden) as expected, Trace.open(path) as actual:
        diff = diff_traces(expected, actual, options)
    run.digest = diff.b.digest
    if diff.identical:
        return None
    run.fails(diff.sentence)
    return render(diff, "text", options)


def _write(run: Path, golden: Path) -> bool:
    """Make the run the golden trace, unless it is the same already: then no file changes."""
    from rsltrace.trace.reader import Trace

    with Trace.open(run) as actual:
        if not actual.complete:
            raise TraceError(f"{run} is cut: its run was killed, so it is no golden trace")
        digest = actual.digest
    try:
        with Trace.open(golden) as expected:
            if expected.complete and expected.digest == digest:
                return False
    except RsltraceError:
        pass  # missing, damaged or of an older format: what the update is for
    if kind := not_replaceable(golden):
        raise OutputError(f"the golden trace {golden} cannot be written: it is {kind}")
    try:
        golden.parent.mkdir(parents=True, exist_ok=True)
        if golden.is_symlink():  # what it points to may be another test's, too
            golden.unlink()
        with replacement_of(golden) as work:
            shutil.copyfile(run, work)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"the golden trace {golden} cannot be written: {reason}") from error
    return True


# Asserting that a node, alone, still does what it did in a recording.

PathLike = str | os.PathLike[str]


class NodeChanged(AssertionError):
    """A node put out something else than was recorded; the message is the table of it."""


def assert_node_unchanged(
    trace: PathLike,
    node: str,
    *,
    bag: PathLike | Sequence[PathLike] | None = None,
    options: DiffOptions | None = None,
    job_folder: PathLike | None = None,
) -> NodeReplayResult:
    """Assert that a node of a trace, fed with what it got then, puts out what it put out then.

    ``bag`` feeds it from rosbag2 recordings; ``trace`` may be a job file, then. ``options`` leave
    fields out or tolerate differences. This runs the code that the trace names.

    :raises NodeChanged: it does not; or there was nothing to compare.
    :raises RsltraceError: it cannot be replayed.
    """
    __tracebackhide__ = True
    from rsltrace.replay import replay_trace
    from rsltrace.replay.one_node.result import as_text

    bags = [bag] if isinstance(bag, (str, os.PathLike)) else bag or ()
    result = replay_trace(
        Path(trace),
        node=node,
        bag=[Path(one) for one in bags],
        options=options,
        job_folder=None if job_folder is None else Path(job_folder),
        trust=True,
    )
    if result.diverged or not result.compared:
        raise NodeChanged("\n".join(as_text(result, everything=False)))
    return result
