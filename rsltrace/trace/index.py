"""The index of a trace: where everything is in the file, from the summary at its end.

An interrupted trace has no summary; ``scan`` makes the same index by walking the file.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import field
from functools import cache
from itertools import accumulate, chain
from struct import unpack
from typing import ClassVar, NamedTuple

import xxhash
from mcap.opcode import Opcode

from rsltrace.errors import TraceError, TraceFormatError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.format import (
    ATTACHMENT_INDEX,
    CHECKSUM_KEY,
    CHECKSUMS_KEY,
    FORMAT_VERSION,
    METADATA_FORMAT,
    SEGMENT_COLUMNS,
)
from rsltrace.trace.mcap import chunk as mcap_chunk
from rsltrace.trace.mcap import reader as mcap_reader
from rsltrace.trace.mcap.records import (
    CHUNK_BYTES_MAX,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    RECORD_HEAD,
    DamageError,
    McapHeader,
    McapSchema,
    RecordFields,
    RecordSpan,
    TruncatedFile,
    crc32,
    records_in,
)
from rsltrace.trace.mcap.source import ByteSource

# Parts of a trace file; errors say where it is damaged and what to do.

_CRC_BYTES = 4
_MESSAGE_BODY_MIN = MESSAGE_HEAD.size - RECORD_HEAD.size
_RECORDS_PER_CHUNK_MAX = 1 << 17
"""More than fit into half a megabyte, at which a payload chunk is closed."""


def damage_error(source: ByteSource, offset: int, what: str, why: object) -> TraceError:
    """Return the error for damage at ``offset`` of the file."""
    return TraceError(
        f"{source.name}: {what} at offset {offset} is damaged ({why}); "
        "copy the file again or record it again"
    )


def read_body(source: ByteSource, span: RecordSpan, opcode: int, what: str) -> bytes:
    """Return the body of the record at ``span``. Raises TraceError if it is not such a record."""
    try:
        return mcap_reader.read_body(source, span, opcode)
    except DamageError as error:
        raise damage_error(source, span.offset, what, error) from error


def read_chunk(source: ByteSource, span: RecordSpan, size_max: int = CHUNK_BYTES_MAX) -> bytes:
    """Return the records of the chunk at ``span``, their CRC checked. Raises TraceError."""
    try:
        return mcap_chunk.read_chunk(source, span, size_max)
    except DamageError as error:
        raise damage_error(source, span.offset, "the chunk", error) from error


def read_attachment(source: ByteSource, span: RecordSpan) -> bytes:
    """Return the data of the attachment at ``span``, its CRC checked. Raises TraceError."""
    body = read_body(source, span, Opcode.ATTACHMENT, "the attachment")
    content, crc = body[:-_CRC_BYTES], body[-_CRC_BYTES:]
    try:
        if crc32(content) != int.from_bytes(crc, "little"):
            raise DamageError("its checksum does not match")
        fields = RecordFields(content)
        fields.take(16)  # times
        fields.text()
        fields.text()
        return fields.take(fields.u64())
    except DamageError as error:
        raise damage_error(source, span.offset, "the attachment", error) from error


def metadata_checksum(name: str, mapping: Mapping[str, str]) -> str:
    """Return the checksum of a metadata record: XXH3 of its name, keys and values, in hex.

    The keys are sorted, and a zero byte separates the texts.
    """
    texts = [name, *chain.from_iterable(sorted(mapping.items()))]
    return xxhash.xxh3_64_hexdigest("\0".join(texts).encode())


def read_metadata(source: ByteSource, span: RecordSpan, *, checked: bool = False) -> dict[str, str]:
    """Return the mapping of the metadata record at ``span``, without its checksum.

    ``checked``: it must have one. Raises TraceError.
    """
    fields = RecordFields(read_body(source, span, Opcode.METADATA, "the metadata"))
    try:
        name, mapping = fields.text(), fields.mapping()
        said = mapping.pop(CHECKSUM_KEY, None)
        if (checked or said is not None) and said != metadata_checksum(name, mapping):
            raise DamageError(f"the checksum of {name!r} does not match")
        return mapping
    except DamageError as error:
        raise damage_error(source, span.offset, "the metadata", error) from error


def messages_in(records: bytes) -> Iterator[tuple[int, int]]:
    """Yield (channel, offset) of the messages of a chunk, in order. Raises DamageError."""
    for number, (opcode, start, end) in enumerate(records_in(records)):
        if number >= _RECORDS_PER_CHUNK_MAX:
            raise DamageError("it holds more records than a chunk of a trace")
        if opcode == MESSAGE:
            if end - start < _MESSAGE_BODY_MIN:
                raise DamageError(f"a message at {start} of the chunk is too short")
            channel_id = int.from_bytes(records[start : start + 2], "little")
            yield channel_id, start - RECORD_HEAD.size


MESSAGE_INDEX_FIXED = 15
"""Bytes of a message index besides its entries: record head, channel, length."""
_INDEX_ENTRY_BYTES = 16
_NO_SCHEMA = McapSchema(0, "", "", "")


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
    """A chunk: its span, the offsets of its message indexes by channel, and where each ends or the
    next begins, rising.

    ``walked`` are the numbers of messages by channel where the chunk was walked: a channel has no
    index if the file was cut off behind the chunk.
    """

    span: RecordSpan
    starts: dict[int, int]
    ends: list[int]
    walked: Mapping[int, int] | None = None

    @property
    def channels(self) -> Iterable[int]:
        return self.starts if self.walked is None else self.walked

    def index_of(self, channel_id: int) -> tuple[int, int]:
        """Return offset and length of the index of a channel (0: there is none)."""
        at = self.starts.get(channel_id, 0)
        place = bisect_right(self.ends, at)
        return (at, self.ends[place] - at) if at and place < len(self.ends) else (0, 0)

    def count_of(self, channel_id: int) -> int:
        """Return how many messages of one of its channels it has: 0 where its index is empty (of
        events and outputs)."""
        if self.walked is not None:
            return self.walked[channel_id]
        return max(self.index_of(channel_id)[1] - MESSAGE_INDEX_FIXED, 0) // _INDEX_ENTRY_BYTES


@dataclass(frozen=True, slots=True)
class SegmentTable:
    """The table of segments as it is in the file: rows of SEGMENT_COLUMNS."""

    ROW_BYTES: ClassVar[int] = 8 * len(SEGMENT_COLUMNS)

    packed: bytes = b""

    def column(self, name: str) -> tuple[int, ...]:
        numbers = unpack(f"<{len(self.packed) // 8}Q", self.packed)
        return numbers[SEGMENT_COLUMNS.index(name) :: len(SEGMENT_COLUMNS)]


@dataclass(slots=True)
class TraceIndex:
    """Where everything is in a trace.

    ``checksums``: its own metadata have some. ``summary_start`` is the end of the data section (0:
    unknown). ``chunks_with`` returns the chunks with messages of some channels, in file order; only
    payloads need these, a long run has thousands. It may raise DamageError.
    """

    complete: bool
    header: McapHeader
    channels: dict[int, ChannelInfo] = field(default_factory=dict)
    message_counts: dict[int, int] = field(default_factory=dict)
    metadata: dict[str, RecordSpan] = field(default_factory=dict)
    attachments: dict[str, RecordSpan] = field(default_factory=dict)
    checksums: bool = False
    summary_start: int = 0
    segments: SegmentTable = SegmentTable()
    chunks_with: Callable[[frozenset[int]], list[ChunkEntry]] = lambda channels: []

    def take(self, summary: mcap_reader.McapSummary) -> None:
        """Add what the records of the file say."""
        self.metadata, self.attachments = summary.metadata, summary.attachments
        for channel_id, schema_id, topic, _, metadata in summary.channels.values():
            _, name, encoding, text = summary.schemas.get(schema_id, _NO_SCHEMA)
            self.channels[channel_id] = ChannelInfo(
                channel_id, topic, name, encoding, text, metadata
            )
        if summary.statistics is not None:
            self.message_counts = summary.statistics.counts


def read_header(source: ByteSource) -> tuple[McapHeader, int]:
    """Return the header and the offset behind it. Raises TraceFormatError if it is not MCAP."""
    head = source.read_at(0, min(source.size, len(MAGIC)))
    if not head:
        raise TraceFormatError(
            f"{source.name} is empty: the run that should have written it ended before it began"
        )
    if not MAGIC.startswith(head):
        what = "an SQLite file, maybe a rosbag2 recording" if head[:6] == b"SQLite" else "not MCAP"
        raise TraceFormatError(
            f"{source.name} is not a trace (it is {what}); a trace is what `rsltrace record` writes"
        )
    try:
        return mcap_reader.read_header(source)
    except TruncatedFile as error:
        raise TraceFormatError(
            f"{source.name} ends in its first record: nothing can be read of it"
        ) from error
    except DamageError as error:
        raise damage_error(source, len(MAGIC), "the header", error) from error


def read_summary(source: ByteSource) -> TraceIndex:
    """Return the index of a finished trace. Raises TraceError if it is damaged or no trace."""
    header, _ = read_header(source)
    index = TraceIndex(complete=True, header=header)
    try:
        footer = mcap_reader.read_footer(source)
    except DamageError as error:
        raise damage_error(source, source.size, "the footer before the end", error) from error
    # Other writers may leave out the summary, or its CRC.
    if not footer.summary_start or not footer.crc:
        raise not_a_trace_error(source, index)
    index.summary_start = footer.summary_start
    try:
        summary = mcap_reader.read_summary(source, footer)
    except DamageError as error:
        raise damage_error(source, footer.summary_start, "the summary", error) from error
    index.take(summary)

    @cache
    def chunks() -> list[ChunkEntry]:
        return [
            ChunkEntry(chunk.span, chunk.indexes, sorted((*chunk.indexes.values(), chunk.end)))
            for chunk in summary.chunks()
        ]

    index.chunks_with = lambda channels: [
        chunk for chunk in (chunks() if channels else ()) if not channels.isdisjoint(chunk.starts)
    ]
    check_version(source, index)
    if ATTACHMENT_INDEX not in index.attachments:
        raise TraceFormatError(f"{source.name} is incomplete: {ATTACHMENT_INDEX} is missing in it")
    index.segments = _read_segments(source, index.attachments[ATTACHMENT_INDEX])
    return index


def check_version(source: ByteSource, index: TraceIndex) -> None:
    """Raise TraceFormatError unless this is a trace of the supported format version."""
    if METADATA_FORMAT not in index.metadata:
        raise not_a_trace_error(source, index)
    found = read_metadata(source, index.metadata[METADATA_FORMAT])
    version = found.get("version", "")
    index.checksums = CHECKSUMS_KEY in found
    if version != str(FORMAT_VERSION):
        raise TraceFormatError(
            f"{source.name} has trace format {version or 'unknown'}, this rsltrace reads "
            f"{FORMAT_VERSION}; it was written by {index.header.library}, which can read it"
        )


def not_a_trace_error(source: ByteSource, index: TraceIndex) -> TraceFormatError:
    """Return the error for an MCAP file of another writer."""
    profile, library = index.header
    writer = f"written by {library!r}" if library else "of an unknown writer"
    use = "; `rsltrace view` and `rsltrace diff` read it, and bags: in a job plays it"
    hint = use if profile == "ros2" else ""
    return TraceFormatError(
        f"{source.name} is a plain MCAP recording ({writer}), not a trace of rsltrace{hint}"
    )


def _read_segments(source: ByteSource, span: RecordSpan) -> SegmentTable:
    data = read_attachment(source, span)
    if len(data) % SegmentTable.ROW_BYTES:
        raise damage_error(source, span.offset, ATTACHMENT_INDEX, "its length is not a multiple")
    table = SegmentTable(data)
    places = ("events_offset", "events_length", "outputs_offset", "outputs_length")
    sound = (
        table.column("first_event") == _starts(table.column("events"))
        and table.column("first_output") == _starts(table.column("outputs"))
        and 0 not in table.column("events")
        and all(max(table.column(name), default=0) <= source.size for name in places)
    )
    if not sound:
        raise damage_error(source, span.offset, ATTACHMENT_INDEX, "its rows contradict each other")
    return table


def _starts(counts: tuple[int, ...]) -> tuple[int, ...]:
    """Return where each count begins, counting from 0."""
    return tuple(accumulate(counts, initial=0))[:-1]
