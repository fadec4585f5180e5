"""The index of a trace that has none: its run was killed, or is still going on.

The file is walked from its start as far as its records are whole. What comes after the last whole
segment (payloads and outputs of events that were never written) belongs to no event. A chunk that
is whole but does not match its checksum is no cut but damage, and an error.
"""

from __future__ import annotations

import numpy as np
from mcap.opcode import Opcode

from rsltrace.trace.format import METADATA_FORMAT, SEGMENT_DTYPE, TOPIC_EVENTS, TOPIC_OUTPUTS
from rsltrace.trace.index import (
    ChunkEntry,
    Schemas,
    TraceIndex,
    add_channel,
    add_schema,
    check_version,
    not_a_trace,
    read_header,
)
from rsltrace.trace.records import (
    RECORD_HEAD,
    Cursor,
    Damaged,
    Span,
    damaged,
    message_at,
    read_body,
    read_chunk,
    read_head,
    walk_messages,
)
from rsltrace.trace.segments import check_numbered, events_in, outputs_in
from rsltrace.trace.source import ByteSource


def scan(source: ByteSource) -> TraceIndex:
    """Return the index of an interrupted trace. Raises TraceError if it is damaged or no trace."""
    return _Scanner(source).run()


class _Scanner:
    def __init__(self, source: ByteSource) -> None:
        self._source = source
        header, self._offset = read_header(source)
        self._index = TraceIndex(complete=False, header=header)
        self._schemas: Schemas = {}
        self._chunks: list[ChunkEntry] = []
        self._rows: list[np.void] = []
        self._event_channel = -1
        self._output_channel = -1
        self._pending_outputs = (Span(0, 0), 0)

    def run(self) -> TraceIndex:
        """Walk the file."""
        if self._take() != Opcode.METADATA or METADATA_FORMAT not in self._index.metadata:
            raise not_a_trace(self._source, self._index)
        check_version(self._source, self._index)
        while self._take() not in (None, Opcode.DATA_END):
            pass
        index = self._index
        if self._rows:
            index.segments = np.array(self._rows, dtype=SEGMENT_DTYPE)
        for entry in self._chunks:
            for channel_id, count in entry.counts.items():
                total = index.message_counts.get(channel_id, 0) + count
                index.message_counts[channel_id] = total
        index.chunks_with = lambda channels: [
            entry for entry in self._chunks if not channels.isdisjoint(entry.counts)
        ]
        return index

    def _take(self) -> int | None:
        """Take over the next record and return its opcode; None where the file was cut off."""
        source, offset = self._source, self._offset
        if offset + RECORD_HEAD.size > source.size:
            return None
        opcode, length = read_head(source, offset)
        # A file system may leave zeros where a crash came before the data; no record begins so.
        if opcode == 0 or offset + length > source.size:
            return None
        span = Span(offset, length)
        self._offset = sum(span)
        try:
            self._take_over(opcode, span)
        except Damaged as error:
            raise damaged(source, offset, "the record", error) from error
        return opcode

    def _take_over(self, opcode: int, span: Span) -> None:
        if opcode == Opcode.CHUNK:
            self._chunk(span)
        elif opcode == Opcode.MESSAGE_INDEX:
            self._message_index(span)
        elif opcode in _NAMED_AFTER:
            cursor = Cursor(read_body(self._source, span, opcode, "the record"))
            cursor.take(_NAMED_AFTER[opcode])
            name = cursor.text()
            target = self._index.metadata if opcode == Opcode.METADATA else self._index.attachments
            target[name] = span
        elif opcode == Opcode.SCHEMA:
            add_schema(self._schemas, read_body(self._source, span, opcode, "the schema"))
        elif opcode == Opcode.CHANNEL:
            body = read_body(self._source, span, opcode, "the channel")
            add_channel(self._index, self._schemas, body)
            ids = {info.topic: info.id for info in self._index.channels.values()}
            self._event_channel = ids.get(TOPIC_EVENTS, -1)
            self._output_channel = ids.get(TOPIC_OUTPUTS, -1)

    def _message_index(self, span: Span) -> None:
        channel_id = Cursor(read_body(self._source, span, Opcode.MESSAGE_INDEX, "the index")).u16()
        if self._chunks:
            last = self._chunks[-1]
            indexes = {**last.indexes, channel_id: span}
            self._chunks[-1] = ChunkEntry(last.span, last.counts, indexes)

    def _chunk(self, span: Span) -> None:
        records = read_chunk(self._source, span)
        channel_id = message_at(records, 0).channel_id
        if channel_id == self._event_channel:
            count = self._events(span, records)
            counts = {channel_id: count}
        elif channel_id == self._output_channel:
            count = len(outputs_in(records, channel_id))
            self._pending_outputs = (span, count)
            counts = {channel_id: count}
        else:
            counts = {}
            for _, message in walk_messages(records):
                counts[message.channel_id] = counts.get(message.channel_id, 0) + 1
        self._chunks.append(ChunkEntry(span, counts, {}))

    def _events(self, span: Span, records: bytes) -> int:
        events = events_in(records, self._event_channel)
        row = np.zeros(1, dtype=SEGMENT_DTYPE)[0]
        if self._rows:
            last = self._rows[-1]
            row["first_event"] = last["first_event"] + last["events"]
            row["first_output"] = last["first_output"] + last["outputs"]
        check_numbered(events, int(row["first_event"]))
        outputs_span, outputs_count = self._pending_outputs
        if outputs_count != int(events["outputs"].sum(dtype=np.uint64)):
            raise Damaged("its events have other outputs than are in the file")
        row["events"] = len(events)
        row["outputs"] = outputs_count
        row["chain_hash"] = events["chain_hash"][-1]
        row["start_stamp"] = events["stamp"].min()
        row["end_stamp"] = events["stamp"].max()
        row["events_offset"], row["events_length"] = span
        row["outputs_offset"], row["outputs_length"] = outputs_span
        self._rows.append(row)
        self._pending_outputs = (Span(0, 0), 0)
        return len(events)


_NAMED_AFTER = {int(Opcode.METADATA): 0, int(Opcode.ATTACHMENT): 16}
"""How many bytes stand before the name in the records that have one."""
