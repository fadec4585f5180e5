"""Find the messages of a trace: by channel and sequence, or all of a topic.

The index has the number of messages by chunk and channel, so bisection finds the chunk with the
n-th message: only that one is decompressed.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from functools import lru_cache
from itertools import chain
from struct import Struct

from mcap.opcode import Opcode

from rsltrace.errors import TraceError
from rsltrace.trace.index import (
    MESSAGE_INDEX_FIXED,
    ChunkEntry,
    TraceIndex,
    damage_error,
    messages_in,
    read_body,
    read_chunk,
)
from rsltrace.trace.mcap.chunk import message_at
from rsltrace.trace.mcap.records import RECORD_HEAD, DamageError, RecordFields, RecordSpan
from rsltrace.trace.mcap.source import ByteSource

_CHUNKS_CACHED = 4
"""Payload chunks have about half a megabyte; two topics side by side need two."""

_INDEX_ENTRY = Struct("<QQ")
"""Of a message: its time, and its offset in the chunk."""


class PayloadReader:
    def __init__(self, source: ByteSource, index: TraceIndex) -> None:
        self._source = source
        self._index = index
        self._records = lru_cache(maxsize=_CHUNKS_CACHED)(self._read_records)
        self._by_channel: dict[int, tuple[list[int], list[ChunkEntry]]] = {}
        self._holding = lru_cache(maxsize=_CHUNKS_CACHED)(self._find_in_chunk)
        self._offsets = lru_cache(maxsize=4 * _CHUNKS_CACHED)(self._read_offsets)

    def message(self, channel_id: int, sequence: int) -> tuple[int, bytes]:
        """Return (stamp in ns, data) of message number ``sequence`` of a channel.

        Raises TraceError if the trace has no such message or is damaged where it is.
        """
        firsts, entries = self._of_channel(channel_id)
        position = bisect_right(firsts, sequence) - 1
        if position < 0:
            raise self._missing(channel_id, sequence)
        entry = entries[position]
        offsets = self._offsets(entry.span, entry.index_of(channel_id), channel_id)
        place = sequence - firsts[position]
        if place >= len(offsets):
            raise self._missing(channel_id, sequence)
        records = self._records(entry.span)
        try:
            message = message_at(records, offsets[place], channel_id)
        except DamageError as error:
            raise damage_error(self._source, entry.span.offset, "the chunk", error) from error
        if message.sequence != sequence:
            raise damage_error(
                self._source, entry.span.offset, "the chunk", "messages are out of order"
            )
        return message.log_time, records[message.start : message.end]

    def messages(self, channel_ids: frozenset[int]) -> Iterator[tuple[int, int, int, bytes]]:
        """Yield (channel, stamp in ns, sequence, data) of all messages of some channels, in file
        order."""
        for entry in self._chunks_with(channel_ids):
            wanted = [c for c in entry.channels if c in channel_ids]
            records = self._read_records(entry.span)
            places = [
                (offset, c)
                for c in wanted
                for offset in self._read_offsets(entry.span, entry.index_of(c), c)
            ]
            try:
                for offset, channel_id in sorted(places):
                    _, sequence, log_time, start, end = message_at(records, offset, channel_id)
                    yield channel_id, log_time, sequence, records[start:end]
            except DamageError as error:
                raise damage_error(self._source, entry.span.offset, "the chunk", error) from error
            del records  # else it would stay while the next, perhaps as large, is read

    def check(self) -> None:
        """Raise TraceError unless each chunk has the messages of its indexes and nothing between:
        other tools walk through it."""
        for entry in self._chunks_with(frozenset(self._index.channels)):
            records, at = self._read_records(entry.span), 0
            found = [self._read_offsets(entry.span, entry.index_of(c), c) for c in entry.channels]
            for offset in sorted(chain.from_iterable(found)):
                if offset != at or at + RECORD_HEAD.size > len(records):
                    break
                at += RECORD_HEAD.size + RECORD_HEAD.unpack_from(records, at)[1]
            else:
                if at == len(records):
                    continue
            why = "its records are not those of its indexes"
            raise damage_error(self._source, entry.span.offset, "the chunk", why)

    def messages_with_text(
        self, channel_id: int, first: int, last: int, text: bytes
    ) -> Iterator[int]:
        """Yield which messages ``first`` … ``last`` of a channel may contain ``text`` in their
        bytes.

        ``text`` is lower case; ASCII letters in the messages may be of either case.
        """
        firsts, entries = self._of_channel(channel_id)
        for position in range(max(bisect_right(firsts, first) - 1, 0), len(entries)):
            if firsts[position] > last:
                return
            for place in self._holding(entries[position].span, text).get(channel_id, ()):
                if first <= firsts[position] + place <= last:
                    yield firsts[position] + place

    def _find_in_chunk(self, span: RecordSpan, text: bytes) -> dict[int, list[int]]:
        """Return by channel which of its messages in a chunk contain ``text``."""
        records = self._records(span)
        folded = records.lower()
        at = folded.find(text)
        if at < 0:
            return {}
        found: dict[int, list[int]] = {}
        counts: dict[int, int] = {}
        try:
            walked = list(messages_in(records))
            ends = [offset for _, offset in walked[1:]] + [len(records)]
            for (channel_id, offset), end in zip(walked, ends, strict=True):
                place = counts[channel_id] = counts.get(channel_id, -1) + 1
                if 0 <= at < end:
                    if at >= offset:
                        found.setdefault(channel_id, []).append(place)
                    at = folded.find(text, end)
        except DamageError as error:
            raise damage_error(self._source, span.offset, "the chunk", error) from error
        return found

    def _chunks_with(self, channel_ids: frozenset[int]) -> list[ChunkEntry]:
        try:
            return self._index.chunks_with(channel_ids)
        except DamageError as error:
            raise TraceError(f"{self._source.name}: the index is damaged ({error})") from error

    def _of_channel(self, channel_id: int) -> tuple[list[int], list[ChunkEntry]]:
        """Return the chunks with messages of a channel, and the first sequence in each."""
        found = self._by_channel.get(channel_id)
        if found is None:
            firsts: list[int] = []
            count = 0
            entries = self._chunks_with(frozenset((channel_id,)))
            for entry in entries:
                firsts.append(count)
                count += entry.count_of(channel_id)
            found = self._by_channel[channel_id] = (firsts, entries)
        return found

    def _read_records(self, span: RecordSpan) -> bytes:
        return read_chunk(self._source, span)

    def _read_offsets(self, span: RecordSpan, index: tuple[int, int], channel_id: int) -> list[int]:
        """Return the offsets of a channel's messages in the records of a chunk."""
        index_span = RecordSpan(*index)
        if index_span.length <= MESSAGE_INDEX_FIXED:
            try:
                walked = messages_in(self._records(span))
                return [offset for channel, offset in walked if channel == channel_id]
            except DamageError as error:
                raise damage_error(self._source, span.offset, "the chunk", error) from error
        body = read_body(self._source, index_span, Opcode.MESSAGE_INDEX, "the message index")
        try:
            fields = RecordFields(body)
            if fields.u16() != channel_id:
                raise DamageError("it is that of another channel")
            entries = fields.take(fields.u32())
            if len(entries) % _INDEX_ENTRY.size:
                raise DamageError("an entry is cut off")
        except DamageError as error:
            raise damage_error(
                self._source, index_span.offset, "the message index", error
            ) from error
        return [offset for _, offset in _INDEX_ENTRY.iter_unpack(entries)]

    def _missing(self, channel_id: int, sequence: int) -> TraceError:
        info = self._index.channels.get(channel_id)
        topic = info.topic if info else f"channel {channel_id}"
        cut = "" if self._index.complete else " (its recording was interrupted)"
        return TraceError(f"{self._source.name} has no message {sequence} on {topic}{cut}")
