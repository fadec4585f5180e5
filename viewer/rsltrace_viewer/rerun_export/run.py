"""One run, exported: its events, logs and messages, one after the other into one recording."""

from __future__ import annotations

from dataclasses import dataclass

import rerun as rr

from rsltrace.trace.reader import Trace
from rsltrace_viewer.rerun_export.columns import Clock
from rsltrace_viewer.rerun_export.events import EventRows
from rsltrace_viewer.rerun_export.logs import LogRows
from rsltrace_viewer.rerun_export.messages import MessageRows, Seen
from rsltrace_viewer.rerun_export.paths import Paths


@dataclass(frozen=True, slots=True)
class Shown:
    """What of one run is in the recording, for the layout."""

    paths: Paths
    seen: Seen
    nodes: tuple[str, ...]
    log_records: int
    mean_gap_ns: int
    """Simulated time per event, on average."""


def export_run(trace: Trace, label: str, clock: Clock, recording: rr.RecordingStream) -> Shown:
    """Send a run as ``label`` (empty, ``a`` or ``b``). Raises TraceError for damage in it."""
    paths = Paths(label, trace)
    events = EventRows(trace, paths, clock)
    recording.send_chunks(events.chunks())
    logs = LogRows(trace, paths, clock)
    recording.send_chunks(logs.chunks())
    messages = MessageRows(trace, paths, clock, recording)
    recording.send_chunks(messages.chunks())
    gap_ns = max(trace.end_ns - trace.start_ns, 1) // max(trace.event_count, 1)
    return Shown(paths, messages.seen, tuple(events.active_nodes), logs.count, max(gap_ns, 1))
