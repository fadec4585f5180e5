"""What a replay is going to run, known before any of it runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rsltrace.errors import ReplayError
from rsltrace.job import Job
from rsltrace.replay.code import Code, code_of
from rsltrace.replay.edits import Edit, edits_of, parse_edit
from rsltrace.replay.job_folder import folder_of, job_in_trace
from rsltrace.replay.trust import why_not_trusted
from rsltrace.run.provenance import environment
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.native import refuse_native
from rsltrace.trace.reader import Trace

Position = int | str
"""An event by its index (an int, or digits), or a simulated time (``2.5``, ``60s``, ``5ms``)."""


@dataclass(frozen=True, slots=True)
class Change:
    """A version, or a setting of the process, that is another one than when a trace was made."""

    name: str
    recorded: str
    present: str


@dataclass(frozen=True, slots=True)
class Preparation:
    """A replay that could begin. ``distrust`` says why somebody has to agree, if so.

    ``code`` is what would run, ``changes`` what else is not as it was. ``trace`` is open.
    """

    trace: Trace
    job: Job
    folder: Path
    code: tuple[Code, ...]
    changes: tuple[Change, ...]
    distrust: str
    notes: tuple[str, ...]
    edits: tuple[Edit, ...] = ()
    """What the run was told to do otherwise, of a trace that is a branch."""


@contextmanager
def prepared(
    path: str | Path,
    job_folder: Path | None = None,
    job: Job | None = None,
    *,
    bags: bool = True,
) -> Iterator[Preparation]:
    """Open a trace and see what replaying it takes. Runs nothing, imports nothing.

    Without ``bags``, those of the job need not be there: they are not going to play.

    ``job`` stands in for the trace's own, which then has to be trusted by whoever gives it.

    :raises TraceError, ReplayError: the trace is damaged, or something that it needs is not here.
    """
    if "://" in str(path):
        raise ReplayError(f"{path}: download a trace to replay it")
    with Trace.open(path) as trace:
        refuse_native(trace, "there is nothing that a replay could do again")
        if trace.event_count == 0:
            raise ReplayError(f"{path} has no events to replay")
        if job is None:
            folder = folder_of(trace, job_folder)
            job = job_in_trace(trace, folder, bags=bags)
            named = job_folder is not None
            distrust = why_not_trusted(trace, job, folder, named=named, bags=bags)
        else:
            folder, distrust = job.base_dir, ""
        yield Preparation(
            trace,
            job,
            folder,
            code_of(job, trace.metadata(METADATA_SOURCES)),
            tuple(_changes(trace)),
            distrust,
            tuple(_notes(trace)),
            tuple(map(parse_edit, edits_of(trace))),
        )


def _changes(trace: Trace) -> Iterator[Change]:
    """Yield what of the environment is not as recorded; libraries are known once they are there."""
    recorded, present = trace.environment, environment()
    for name in sorted({*recorded, *present} - {"numerics", "ros_distro", "addresses"}):
        if recorded.get(name) != present.get(name):
            yield Change(name, recorded.get(name, ""), present.get(name, ""))


def _notes(trace: Trace) -> Iterator[str]:
    if not trace.complete:
        yield (
            f"the trace was cut off: it is replayed as far as it goes, {trace.event_count} events"
        )


def count_to(trace: Trace, position: Position) -> int:
    """Return how many events there are up to a position, that event (or time) included.

    :raises ReplayError: if it is no position, or before the first event.
    """
    from rsltrace.trace.words.times import parse_time_in_run

    text = str(position).strip()
    if text.isascii() and text.isdigit():
        return int(text) + 1
    try:
        time_ns = parse_time_in_run(text).stamp_ns(trace.start_ns)
    except ValueError as error:
        raise ReplayError(
            f"{text!r} is neither the index of an event (812) nor a time (60s, 2.5): {error}"
        ) from None
    count = 0
    for rows in trace.events():
        late = (rows["stamp"] > time_ns) & (rows["kind"] != EventKind.CONSTRUCT)
        if late.any():
            return count + int(late.argmax())
        count += len(rows)
    return count
