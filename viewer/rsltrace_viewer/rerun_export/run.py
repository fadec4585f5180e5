"""One run, exported: its events, logs and messages, one after the other into one recording."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk, McapReader

from rsltrace.errors import TraceError
from rsltrace.trace.format import TOPIC_ROSOUT
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.reader import Trace
from rsltrace.trace.segments import output_of
from rsltrace_viewer.rerun_export.columns import Clock, make_chunk
from rsltrace_viewer.rerun_export.events.chunks import EventRows
from rsltrace_viewer.rerun_export.messages.chunks import MessageRows, Seen
from rsltrace_viewer.rerun_export.moments import NO_NODE, Moments, Paths

# What nodes said: log records with their levels, and the tracebacks of exceptions.
#
# Rerun's loader reads ``/rosout``; which node a record is from, the trace knows better than a name
# in the record, since the sender is an entity.

_LOG_TIME = "message_log_time"
_COLUMNS = ("TextLog:text", "TextLog:level")


class LogRows:
    """Makes chunks of the log records and exceptions of one trace. ``count`` is how many."""

    def __init__(self, trace: Trace, paths: Paths, clock: Clock) -> None:
        self.count = 0
        self._trace = trace
        self._paths = paths
        self._clock = clock

    def chunks(self) -> Iterator[Chunk]:
        """Yield all chunks. Raises TraceError where the trace is damaged."""
        if any(channel.topic == TOPIC_ROSOUT for channel in self._trace.channels.values()):
            yield from self._records()
        yield from self._exceptions()

    def _records(self) -> Iterator[Chunk]:
        moments = Moments(self._trace)
        try:
            reader = McapReader(
                self._trace.name,
                timeline_type=self._clock.timeline_type,
                decoders=("ros2msg", "ros2_reflection"),
                include_topic_regex=[f"^{re.escape(TOPIC_ROSOUT)}$"],
                recover=not self._trace.complete,
            )
            for chunk in reader.stream():
                batch = chunk.to_record_batch()
                names = set(batch.schema.names)
                if set(_COLUMNS) <= names:
                    if _LOG_TIME not in names:
                        raise ValueError("one does not fit its type")
                    yield from self._split(batch, moments)
        except (RuntimeError, ValueError, OSError) as error:
            raise TraceError(
                f"{self._trace.name}: Rerun cannot read its log records ({error})"
            ) from error

    def _split(self, batch: pa.RecordBatch, moments: Moments) -> Iterator[Chunk]:
        stamps = batch.column(_LOG_TIME).cast(pa.int64()).to_numpy()
        events, senders = moments.of_messages(TOPIC_ROSOUT, TOPIC_ROSOUT, stamps)
        self.count += len(stamps)
        texts, levels = (batch.column(name) for name in _COLUMNS)
        by_path: dict[str, list[int]] = {}
        for sender in np.unique(senders).tolist():
            entity = self._trace.entities.get(sender)
            name = self._paths.node_name(entity) if entity else NO_NODE
            by_path.setdefault(f"{self._paths.node(name)}/log", []).append(sender)
        for path, own in by_path.items():
            places = np.flatnonzero(np.isin(senders, own))
            rows = pa.array(places)
            yield from make_chunk(
                path,
                self._clock.times(stamps[places], events[places]),
                (
                    (rr.TextLog.descriptor_text(), texts.take(rows)),
                    (rr.TextLog.descriptor_level(), levels.take(rows)),
                ),
            )

    def _exceptions(self) -> Iterator[Chunk]:
        for events, outputs in zip(self._trace.events(), self._trace.outputs(), strict=True):
            for row in outputs[outputs["kind"] == int(OutputKind.EXCEPTION)]:
                output = output_of(row, self._trace.name)
                event = events[output.event - int(events["index"][0])]
                entity = self._trace.entities.get(int(event["entity"]))
                name = self._paths.node_name(entity) if entity else NO_NODE
                text = self._trace.detail(output) or "an exception; its traceback was not kept"
                text = f"[{name.strip('/')}] {text.rstrip()}"  # as the loader begins log records
                self.count += 1
                yield from make_chunk(
                    f"{self._paths.node(name)}/log",
                    self._clock.times(np.array([event["stamp"]]), np.array([output.event])),
                    (
                        (rr.TextLog.descriptor_text(), pa.array([text])),
                        (rr.TextLog.descriptor_level(), pa.array(["CRITICAL"])),
                    ),
                )


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
