"""One run, exported: its events, logs and messages, one after the other into one recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import rerun as rr
from rerun.chunk import Chunk

from rsltrace.trace.format import TOPIC_ROSOUT
from rsltrace.trace.reader import Trace
from rsltrace_viewer.rerun_export.columns import Clock
from rsltrace_viewer.rerun_export.events.chunks import EventRows
from rsltrace_viewer.rerun_export.events.logs import LogRows
from rsltrace_viewer.rerun_export.messages.chunks import MessageRows, Seen
from rsltrace_viewer.rerun_export.paths import Paths

_CHUNKS_AHEAD = 32


@dataclass(frozen=True, slots=True)
class Shown:
    """What of one run is in the recording, for the layout."""

    paths: Paths
    seen: Seen
    nodes: tuple[str, ...]
    log_records: int
    mean_gap_ns: int
    """Simulated time per event, on average."""
    left_out: dict[str, str]
    """Topics whose messages are not in it, and why."""


def export_run(trace: Trace, label: str, clock: Clock, recording: rr.RecordingStream) -> Shown:
    """Send a run as ``label`` (empty, ``a`` or ``b``). Raises TraceError for damage in it."""
    paths = Paths(label, trace)
    events = EventRows(trace, paths, clock)
    _send(recording, events.chunks())
    messages = MessageRows(trace, paths, clock, recording)
    logs = LogRows(trace, paths, clock)
    if TOPIC_ROSOUT not in messages.left_out:
        _send(recording, logs.chunks())
    _send(recording, messages.chunks())
    gap_ns = max(trace.end_ns - trace.start_ns, 1) // max(trace.event_count, 1)
    return Shown(
        paths,
        messages.seen,
        tuple(events.active_nodes),
        logs.count,
        max(gap_ns, 1),
        messages.left_out,
    )


def _send(recording: rr.RecordingStream, chunks: Iterator[Chunk]) -> None:
    """Send chunks, never far ahead of what is written: Rerun's queue to the file has no end."""
    while batch := list(islice(chunks, _CHUNKS_AHEAD)):
        recording.send_chunks(batch)
        recording.flush()
