"""Make the index of a trace without summary: its run was killed, or is still going on.

The file is walked as far as its records are whole. Payloads and outputs after the last whole
segment belong to no event. A whole record that does not match its checksum, or is followed by other
bytes, is damage and an error.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np
from mcap.opcode import Opcode

from rsltrace.errors import TraceError, TraceFormatError
from rsltrace.trace.dtypes import SEGMENT_DTYPE
from rsltrace.trace.format import (
    METADATA_FORMAT,
    TOPIC_DETAILS,
    TOPIC_ENTITIES,
    TOPIC_EVENTS,
    TOPIC_OUTPUTS,
    begins_a_trace,
)
from rsltrace.trace.index import (
    ChunkEntry,
    SegmentTable,
    TraceIndex,
    check_version,
    messages_in,
    not_a_trace_error,
    read_header,
)
from rsltrace.trace.mcap.chunk import read_chunk
from rsltrace.trace.mcap.reader import McapSummary, length_by_fields, read_body, whole_records
from rsltrace.trace.mcap.records import DamageError, RecordFields, RecordSpan
from rsltrace.trace.mcap.source import ByteSource
from rsltrace.trace.segments import check_numbered, events_in, outputs_in, segment_row


def scan(source: ByteSource) -> TraceIndex:
    """Return the index of an interrupted trace. Raises TraceError if it is damaged or no trace."""
    return _Scanner(source).run()


class _Scanner:
    def __init__(self, source: ByteSource) -> None:
        self._source = source
        header, self._whole = read_header(source)
        self._index = TraceIndex(complete=False, header=header)
        self._summary = McapSummary()
        self._chunks: list[ChunkEntry] = []
        self._rows: list[np.void] = []
        self._event_channel = -1
        self._output_channel = -1
        self._pending_outputs = (RecordSpan(0, 0), 0)
        self._what = "the record"

    def run(self) -> TraceIndex:
        index, summary = self._index, self._summary
        number = 0
        try:
            for number, (opcode, span) in enumerate(whole_records(self._source)):
                if number == 0:  # the header
                    continue
                if number == 1 and opcode != Opcode.METADATA:
                    break
                self._what = "the chunk" if opcode == Opcode.CHUNK else "the record"
                self._take(opcode, span)
                if number == 1:
                    index.metadata = summary.metadata
                    check_version(self._source, index)
                if opcode == Opcode.DATA_END:
                    break
                self._whole, self._what = span.end, "the record"
        except DamageError as error:
            raise self._damaged(error) from error
        if METADATA_FORMAT not in summary.metadata:
            if number == 0 and begins_a_trace(index.header):
                raise TraceFormatError(
                    f"{self._source.name} is a trace of {index.header.library} that was cut behind "
                    "its header, before anything of the run was in it (its run was killed, or has "
                    "just begun): nothing can be read of it; record it again"
                )
            raise not_a_trace_error(self._source, index)
        index.take(summary)
        if self._rows:
            index.segments = SegmentTable(np.array(self._rows, dtype=SEGMENT_DTYPE).tobytes())
        for entry in self._chunks:
            for channel_id in entry.channels:
                total = index.message_counts.get(channel_id, 0) + entry.count_of(channel_id)
                index.message_counts[channel_id] = total
        index.chunks_with = lambda channels: [
            entry for entry in self._chunks if not channels.isdisjoint(entry.channels)
        ]
        return index

    def _take(self, opcode: int, span: RecordSpan) -> None:
        if opcode == Opcode.CHUNK:
            self._chunk(span)
            return
        if opcode == Opcode.DATA_END:
            return
        body = read_body(self._source, span, opcode)
        said = length_by_fields(opcode, body)
        if said != len(body):
            raise DamageError(f"its length is given as {len(body)}, its fields say {said}")
        if opcode == Opcode.MESSAGE_INDEX:
            self._message_index(span, RecordFields(body).u16())
        elif opcode in _NAMED_AFTER:
            fields = RecordFields(body)
            fields.take(_NAMED_AFTER[opcode])
            metadata, attachments = self._summary.metadata, self._summary.attachments
            (metadata if opcode == Opcode.METADATA else attachments)[fields.text()] = span
        else:
            self._summary.add(opcode, body)
            ids = {channel.topic: channel.id for channel in self._summary.channels.values()}
            self._event_channel = ids.get(TOPIC_EVENTS, -1)
            self._output_channel = ids.get(TOPIC_OUTPUTS, -1)

    def _message_index(self, span: RecordSpan, channel_id: int) -> None:
        if not self._chunks or channel_id not in self._chunks[-1].channels:
            raise DamageError("it is not the index of the chunk before it")
        self._chunks[-1].starts[channel_id] = span.offset
        self._chunks[-1].ends.append(span.end)

    def _chunk(self, span: RecordSpan) -> None:
        records = read_chunk(self._source, span)
        self._check_channels()
        counts: Mapping[int, int]
        channel_id, _ = next(messages_in(records), (-1, 0))
        if channel_id == self._event_channel:
            counts = {channel_id: self._events(span, records)}
        elif channel_id == self._output_channel:
            counts = {channel_id: len(outputs_in(records, channel_id))}
            self._pending_outputs = (span, counts[channel_id])
        else:
            counts = Counter(channel_id for channel_id, _ in messages_in(records))
            for channel_id in counts.keys() - self._summary.channels.keys():
                raise DamageError(f"it has messages of channel {channel_id}, which is not there")
        self._chunks.append(ChunkEntry(span, {}, [], counts))

    def _check_channels(self) -> None:
        """Check that rsltrace's channels precede the chunks: no checksum covers their names."""
        topics = {channel.topic for channel in self._summary.channels.values()}
        for topic in _OWN - topics:
            raise DamageError(f"there is no channel {topic} before it")

    def _events(self, span: RecordSpan, records: bytes) -> int:
        events = events_in(records, self._event_channel)
        first_event = first_output = 0
        if self._rows:
            last = self._rows[-1]
            first_event = int(last["first_event"] + last["events"])
            first_output = int(last["first_output"] + last["outputs"])
        check_numbered(events, first_event)
        outputs_span, outputs_count = self._pending_outputs
        if outputs_count != int(events["outputs"].sum(dtype=np.uint64)):
            raise DamageError("its events have other outputs than are in the file")
        firsts = (first_event, first_output)
        self._rows.append(segment_row(events, outputs_count, firsts, span, outputs_span)[0])
        self._pending_outputs = (RecordSpan(0, 0), 0)
        return len(events)

    def _damaged(self, why: DamageError) -> TraceError:
        name, whole, size = self._source.name, self._whole, self._source.size
        return TraceError(
            f"{name}: {self._what} at offset {whole} is damaged ({why}): the first {whole} of "
            f"{size} bytes are whole, and more follows; copy the file again or record it again "
            f"(head -c {whole} keeps what is whole)"
        )


_OWN = frozenset((TOPIC_EVENTS, TOPIC_OUTPUTS, TOPIC_ENTITIES, TOPIC_DETAILS))

_NAMED_AFTER = {int(Opcode.METADATA): 0, int(Opcode.ATTACHMENT): 16}
"""The number of bytes before the name, in the records that have one."""
