"""The whole export: one run or two, and where they diverge, into one Rerun recording (.rrd)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from threading import Thread

import rerun as rr

from rsltrace.diff.result import Diff
from rsltrace.diff.traces.aligned_runs import AlignedRuns
from rsltrace.diff.traces.diff import diff_traces
from rsltrace.errors import OutputError
from rsltrace.trace.model.regular_file import check_output_file, replacement_of
from rsltrace.trace.native import refuse_native, run_name
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.phrases import notes_on
from rsltrace_viewer.rerun_export.columns import clocks_for, joining_chunks
from rsltrace_viewer.rerun_export.divergence import (
    Distances,
    DivergenceMarks,
    distance_chunks,
    divergence_chunks,
    marks_of,
)
from rsltrace_viewer.rerun_export.layout import IMAGES_MAX, blueprint
from rsltrace_viewer.rerun_export.run import export_run
from rsltrace_viewer.rerun_export.sdk import APPLICATION_ID

_PIECE_BYTES = 1 << 16


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written: events and bytes, of the traces and of the recording.

    ``notes`` say of which topics it has no messages, and why, and how far a truncated trace goes.
    """

    path: Path
    events: int
    trace_bytes: int
    bytes: int
    notes: tuple[str, ...]


def export(
    traces: Sequence[Path], output: Path, *, force: bool = False, by_event: bool = False
) -> Exported:
    """Write one or two traces to the Rerun recording ``output``, with a layout made for them.

    It opens on simulated time, or ``by_event``. Two traces are compared, and where they diverge is
    explained and marked. The recording appears when it is complete, or not at all: then what was
    there before stays. Raises TraceError for damaged traces, and OutputError if ``output`` exists
    (without ``force``) or cannot be written.
    """
    assert len(traces) in (1, 2)
    check_output_file(output, traces, force=force, example="run.rrd")
    with ExitStack() as stack:
        opened = [stack.enter_context(Trace.open(path)) for path in traces]
        for trace in opened if len(opened) == 2 else ():
            refuse_native(trace, "its events are at times of their own (see rsltrace diff)")
        diff = diff_traces(opened[0], opened[1]) if len(opened) == 2 else None
        recording = rr.RecordingStream(
            APPLICATION_ID,
            recording_id="-".join(trace.digest for trace in opened),
            send_properties=False,
        )
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        try:
            with replacement_of(output) as work, _saved(recording, work):
                left_out = _send(opened, recording, diff, by_event=by_event)
        except OSError as error:
            reason = error.strerror or error
            raise OutputError(f"{output} cannot be written: {reason}") from error
        return Exported(
            output,
            sum(trace.event_count for trace in opened),
            sum(trace.size for trace in opened),
            output.stat().st_size,
            (*chain.from_iterable(map(notes_on, opened)), *left_out),
        )


@contextmanager
def _saved(recording: rr.RecordingStream, path: Path) -> Iterator[None]:
    """Write what is sent to a recording, and its index at the end, to a file.

    Rerun writes to a pipe, not to the file: of a full disk its own writer hangs, or says nothing.

    :raises OSError: not all could be written.
    """
    errors: list[OSError] = []
    reading, writing = os.pipe()

    def copy() -> None:
        with open(reading, "rb", buffering=0) as source:
            while data := source.read(_PIECE_BYTES):
                try:
                    if not errors:
                        file.write(data)
                except OSError as error:
                    errors.append(error)

    with path.open("wb") as file:
        copier = Thread(target=copy, daemon=True)
        copier.start()
        try:
            recording.save(f"/proc/self/fd/{writing}")
        finally:
            os.close(writing)
        try:
            yield
        finally:
            recording.disconnect()
            copier.join()
    if errors:
        raise errors[0]


def _send(
    opened: Sequence[Trace], recording: rr.RecordingStream, diff: Diff | None, *, by_event: bool
) -> list[str]:
    """Send it all; return what is left out."""
    runs = _aligned(opened) if diff is not None else None
    rows = runs.rows if runs is not None else None
    clocks = clocks_for([trace.start_ns for trace in opened], rows)
    labels = ("",) if len(opened) == 1 else ("a", "b")
    names = " and ".join(f"{Path(trace.name).name} {run_name(trace)}" for trace in opened)
    recording.send_recording_name(names)
    shown = [
        export_run(trace, label, clock, recording)
        for trace, label, clock in zip(opened, labels, clocks, strict=True)
    ]
    marks: DivergenceMarks | None = None
    if len(opened) == 2:
        trees = [run.seen.frames for run in shown]
        recording.send_chunks(joining_chunks(list(labels), trees))
    distances = Distances()
    if diff is not None and runs is not None:
        marks = marks_of(diff, runs)
        recording.send_chunks(distance_chunks(shown, clocks, distances))
        start_ns = min(trace.start_ns for trace in opened)
        recording.send_chunks(divergence_chunks(diff, runs, start_ns, clocks[0]))
    layout = blueprint(shown, marks, distances, by_event=by_event)
    recording.send_blueprint(layout, make_active=True, make_default=True)
    notes = [
        f"{trace.name}: no messages on {topic}: {why}"
        for trace, run in zip(opened, shown, strict=True)
        for topic, why in run.left_out.items()
    ]
    for trace, run in zip(opened, shown, strict=True):
        if hidden := list(run.seen.images)[IMAGES_MAX:]:
            topics = ", ".join(run.seen.topic_of.get(path, path) for path in hidden)
            notes.append(f"{trace.name}: the layout has no view of the images on {topics}: add one")
    return notes


def _aligned(opened: Sequence[Trace]) -> AlignedRuns:
    """Return the rows of two runs, all that can be compared."""
    runs = AlignedRuns(*opened)
    while not runs.done:
        runs.take(runs.fetch())
    return runs
