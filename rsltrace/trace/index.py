"""What is where in a trace file, and how the summary at its end tells.

An interrupted trace has no summary; ``scan`` makes the same index by walking the file.
"""

from __future__ import annotations

import struct
from binascii import crc32
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from rsltrace.errors import TraceFormatError
from rsltrace.trace.format import (
    ATTACHMENT_INDEX,
    FORMAT_VERSION,
    MCAP_MAGIC,
    METADATA_FORMAT,
    SEGMENT_DTYPE,
)
from rsltrace.trace.records import (
    RECORD_HEAD,
    Cursor,
    Damaged,
    Span,
    damaged,
    read_body,
    read_head,
)
from rsltrace.trace.source import ByteSource

_FOOTER = struct.Struct("<QQI")
_FOOTER_BYTES = RECORD_HEAD.size + _FOOTER.size
_CRC = struct.Struct("<I")
_MESSAGE_INDEX_FIXED = RECORD_HEAD.size + 6
_INDEX_ENTRY_BYTES = 16
_CHUNK_INDEX = int(Opcode.CHUNK_INDEX)
_CHUNK_INDEX_HEAD = struct.Struct("<QQQQI")
_OFFSET_ENTRY = struct.Struct("<HQ")
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")


class Header(NamedTuple):
    """The first record of the file: the profile (``ros2``) and what wrote it."""

    profile: str
    library: str


@dataclass(frozen=True, slots=True)
class ChannelInfo:
    """A channel: a topic with its type and the ros2msg text of its schema."""

    id: int
    topic: str
    type: str
    schema_encoding: str
    schema_text: str
    metadata: Mapping[str, str]


class ChunkEntry(NamedTuple):
    """A chunk: where it is, how many messages of each channel it holds, where their indexes are.

    A channel without an index (the file was cut off behind the chunk) is found by walking.
    """

    span: Span
    counts: Mapping[int, int]
    indexes: Mapping[int, Span]


@dataclass(slots=True)
class TraceIndex:
    """Everything needed to find things in a trace. ``segments`` is SEGMENT_DTYPE, shape (n,).

    ``summary_start`` is where the data section is over (0: nobody knows). ``chunks_with`` returns,
    in file order, the chunks that hold messages of some channels: a long run has thousands, which
    only payloads need and opening does not. It may raise Damaged.
    """

    complete: bool
    header: Header
    channels: dict[int, ChannelInfo] = field(default_factory=dict)
    message_counts: dict[int, int] = field(default_factory=dict)
    metadata: dict[str, Span] = field(default_factory=dict)
    attachments: dict[str, Span] = field(default_factory=dict)
    summary_start: int = 0
    segments: npt.NDArray[np.void] = field(default_factory=lambda: np.zeros(0, SEGMENT_DTYPE))
    chunks_with: Callable[[frozenset[int]], list[ChunkEntry]] = lambda channels: []


Schemas = dict[int, tuple[str, str, str]]
"""By schema id: name, encoding, text."""


def read_header(source: ByteSource) -> tuple[Header, int]:
    """Return the header and the offset behind it. Raises TraceFormatError if it is not MCAP."""
    head = source.read_at(0, min(source.size, 16))
    if not head:
        raise TraceFormatError(
            f"{source.name} is empty: the run that should have written it ended before it began"
        )
    if head[: len(MCAP_MAGIC)] != MCAP_MAGIC[: len(head)]:
        what = "an SQLite file, maybe a rosbag2 recording" if head[:6] == b"SQLite" else "not MCAP"
        raise TraceFormatError(
            f"{source.name} is not a trace (it is {what}); a trace is what `rsltrace record` writes"
        )
    offset = len(MCAP_MAGIC)
    if source.size < offset + RECORD_HEAD.size or source.size < sum(
        span := Span(offset, read_head(source, offset)[1])
    ):
        raise TraceFormatError(f"{source.name} ends in its first record: nothing can be read of it")
    try:
        cursor = Cursor(read_body(source, span, Opcode.HEADER, "the header"))
        return Header(cursor.text(), cursor.text()), sum(span)
    except Damaged as error:
        raise damaged(source, offset, "the header", error) from error


def has_end(source: ByteSource) -> bool:
    """Return whether the file ends as a finished MCAP file does."""
    size = len(MCAP_MAGIC)
    if source.size < 2 * size + _FOOTER_BYTES:
        return False
    return source.read_at(source.size - size, size) == MCAP_MAGIC


def read_summary(source: ByteSource) -> TraceIndex:
    """Return the index of a finished trace. Raises TraceError if it is damaged or no trace."""
    header, _ = read_header(source)
    index = TraceIndex(complete=True, header=header)
    footer_at = source.size - len(MCAP_MAGIC) - _FOOTER_BYTES
    footer = read_body(source, Span(footer_at, _FOOTER_BYTES), Opcode.FOOTER, "the footer")
    start, _, crc = _FOOTER.unpack(footer)
    if not 0 < start <= footer_at:
        if start == 0:
            raise not_a_trace(source, index)
        raise damaged(source, footer_at, "the footer", "the summary would be outside of the file")
    index.summary_start = start
    data = source.read_at(start, footer_at - start + _FOOTER_BYTES)
    if crc32(data[: -_CRC.size]) != crc:
        # Other writers may leave the CRC out; then this is no trace of ours, which says it better.
        if crc == 0:
            raise not_a_trace(source, index)
        raise damaged(source, start, "the summary", "its checksum does not match")
    try:
        _parse_summary(index, data[:-_FOOTER_BYTES])
    except Damaged as error:
        raise damaged(source, start, "the summary", error) from error
    check_version(source, index)
    if ATTACHMENT_INDEX not in index.attachments:
        raise TraceFormatError(f"{source.name} is incomplete: {ATTACHMENT_INDEX} is missing in it")
    index.segments = _read_segments(source, index.attachments[ATTACHMENT_INDEX])
    return index


def _parse_summary(index: TraceIndex, summary: bytes) -> None:
    schemas: Schemas = {}
    chunks: list[int] = []
    position, head_bytes, unpack = 0, RECORD_HEAD.size, RECORD_HEAD.unpack_from
    while position < len(summary):
        if position + head_bytes > len(summary):
            raise Damaged("its last record is cut off")
        opcode, length = unpack(summary, position)
        begin = position + head_bytes
        position = begin + length
        if opcode == _CHUNK_INDEX and position <= len(summary):
            chunks.append(begin)  # there are thousands in a long run, and few are ever looked at
            continue
        if position > len(summary):
            raise Damaged("its last record is cut off")
        body = summary[begin:position]
        if opcode == Opcode.SCHEMA:
            add_schema(schemas, body)
        elif opcode == Opcode.CHANNEL:
            add_channel(index, schemas, body)
        elif opcode == Opcode.STATISTICS:
            index.message_counts = _message_counts(body)
        elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            entry = Cursor(body)
            span = Span(entry.u64(), entry.u64())
            if opcode == Opcode.ATTACHMENT_INDEX:
                entry.take(24)  # log time, creation time, size
                index.attachments[entry.text()] = span
            else:
                index.metadata[entry.text()] = span
    index.chunks_with = lambda channels: [
        _chunk_entry(summary, begin)
        for begin in chunks
        if not channels.isdisjoint(_channels_of_chunk(summary, begin))
    ]


def add_schema(schemas: Schemas, body: bytes) -> None:
    """Take over a Schema record. Raises Damaged."""
    cursor = Cursor(body)
    schema_id = cursor.u16()
    schemas[schema_id] = (cursor.text(), cursor.text(), cursor.text())


def add_channel(index: TraceIndex, schemas: Schemas, body: bytes) -> None:
    """Take over a Channel record, whose schema must be there. Raises Damaged."""
    cursor = Cursor(body)
    channel_id, schema_id = cursor.u16(), cursor.u16()
    topic, _, metadata = cursor.text(), cursor.text(), cursor.mapping()
    name, encoding, text = schemas.get(schema_id, ("", "", ""))
    index.channels[channel_id] = ChannelInfo(channel_id, topic, name, encoding, text, metadata)


def _message_counts(statistics: bytes) -> dict[int, int]:
    cursor = Cursor(statistics)
    cursor.take(42)  # counts of other things, and the times of the first and last message
    return {row[0]: row[1] for row in cursor.integers("<HQ")}


def _channels_of_chunk(summary: bytes, begin: int) -> Iterable[int]:
    """Return the channels of the ChunkIndex whose body begins at ``begin`` (and is whole)."""
    map_at, map_end = _map_of_chunk(summary, begin)
    if map_end - map_at == _OFFSET_ENTRY.size:  # events or outputs: most chunks
        return (_OFFSET_ENTRY.unpack_from(summary, map_at)[0],)
    return [channel_id for channel_id, _ in _OFFSET_ENTRY.iter_unpack(summary[map_at:map_end])]


def _map_of_chunk(summary: bytes, begin: int) -> tuple[int, int]:
    """Return where the map of message indexes in a ChunkIndex begins and ends. Raises Damaged."""
    (body_bytes,) = _U64.unpack_from(summary, begin - _U64.size)
    map_at = begin + _CHUNK_INDEX_HEAD.size
    if body_bytes >= _CHUNK_INDEX_HEAD.size:
        (map_bytes,) = _U32.unpack_from(summary, map_at - _U32.size)
        map_end: int = map_at + map_bytes
        if map_bytes % _OFFSET_ENTRY.size == 0 and map_end + _U64.size <= begin + body_bytes:
            return map_at, map_end
    raise Damaged("an entry of the list of chunks is cut off")


def _chunk_entry(summary: bytes, begin: int) -> ChunkEntry:
    """Read the ChunkIndex whose body begins at ``begin`` (and is whole). Raises Damaged."""
    map_at, map_end = _map_of_chunk(summary, begin)
    _, _, offset, length, _ = _CHUNK_INDEX_HEAD.unpack_from(summary, begin)
    span = Span(offset, length)
    # Each index reaches to the next one: that gives its length, and so the number of messages.
    entries = _OFFSET_ENTRY.iter_unpack(summary[map_at:map_end])
    starts = [(index_at, channel_id) for channel_id, index_at in entries]
    behind = offset + length + _U64.unpack_from(summary, map_end)[0]
    starts.sort()
    indexes: dict[int, Span] = {}
    counts: dict[int, int] = {}
    for position, (index_at, channel_id) in enumerate(starts):
        next_at = starts[position + 1][0] if position + 1 < len(starts) else behind
        indexes[channel_id] = Span(index_at, next_at - index_at)
        counts[channel_id] = (next_at - index_at - _MESSAGE_INDEX_FIXED) // _INDEX_ENTRY_BYTES
    return ChunkEntry(span, counts, indexes)


def read_attachment(source: ByteSource, span: Span) -> bytes:
    """Return the data of the attachment at ``span``, its CRC checked. Raises TraceError."""
    body = read_body(source, span, Opcode.ATTACHMENT, "the attachment")
    try:
        if len(body) < _CRC.size or crc32(body[: -_CRC.size]) != _CRC.unpack(body[-_CRC.size :])[0]:
            raise Damaged("its checksum does not match")
        cursor = Cursor(body[: -_CRC.size])
        cursor.take(16)  # times
        cursor.text()
        cursor.text()
        return cursor.take(cursor.u64())
    except Damaged as error:
        raise damaged(source, span.offset, "the attachment", error) from error


def read_metadata(source: ByteSource, span: Span) -> dict[str, str]:
    """Return the mapping of the metadata record at ``span``. Raises TraceError."""
    body = read_body(source, span, Opcode.METADATA, "the metadata")
    try:
        cursor = Cursor(body)
        cursor.text()
        return cursor.mapping()
    except Damaged as error:
        raise damaged(source, span.offset, "the metadata", error) from error


def check_version(source: ByteSource, index: TraceIndex) -> None:
    """Raise TraceFormatError unless this is a trace of the format version that is read here."""
    if METADATA_FORMAT not in index.metadata:
        raise not_a_trace(source, index)
    version = read_metadata(source, index.metadata[METADATA_FORMAT]).get("version", "")
    if version != str(FORMAT_VERSION):
        raise TraceFormatError(
            f"{source.name} has trace format {version or 'unknown'}, this rsltrace reads "
            f"{FORMAT_VERSION}; it was written by {index.header.library}, which can read it"
        )


def not_a_trace(source: ByteSource, index: TraceIndex) -> TraceFormatError:
    """Return the error for an MCAP file that somebody else wrote."""
    profile, library = index.header
    writer = f"written by {library!r}" if library else "of an unknown writer"
    hint = "; to use it as input, name it under bags: in a job" if profile == "ros2" else ""
    return TraceFormatError(
        f"{source.name} is a plain MCAP recording ({writer}), not a trace of rsltrace{hint}"
    )


def _read_segments(source: ByteSource, span: Span) -> npt.NDArray[np.void]:
    data = read_attachment(source, span)
    if len(data) % SEGMENT_DTYPE.itemsize:
        raise damaged(source, span.offset, ATTACHMENT_INDEX, "its length is not a multiple")
    segments = np.frombuffer(data, dtype=SEGMENT_DTYPE)
    size = np.uint64(source.size)
    sound = all(
        (
            np.array_equal(segments["first_event"], _starts(segments["events"])),
            np.array_equal(segments["first_output"], _starts(segments["outputs"])),
            bool((segments["events"] > 0).all()),
            bool((segments["events_offset"] <= size).all()),
            bool((segments["events_length"] <= size).all()),
            bool((segments["outputs_offset"] <= size).all()),
            bool((segments["outputs_length"] <= size).all()),
        )
    )
    if not sound:
        raise damaged(source, span.offset, ATTACHMENT_INDEX, "its rows contradict each other")
    return segments


def _starts(counts: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Return where each count begins when they follow each other from 0."""
    return np.cumsum(counts, dtype=np.uint64) - counts
