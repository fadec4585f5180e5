"""The end of an MCAP file, as it is read: what is where in it."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.opcode import Opcode

from rsltrace.trace.mcap.checksum import crc32
from rsltrace.trace.mcap.records import (
    MAGIC,
    RECORD_HEAD,
    SUMMARY_BYTES_MAX,
    Channel,
    ChunkIndex,
    CutOff,
    Damaged,
    Fields,
    Header,
    Schema,
    Span,
    Statistics,
    channels_of_chunk_index,
    parse_channel,
    parse_chunk_index,
    parse_header,
    parse_schema,
    parse_statistics,
    records_in,
)
from rsltrace.trace.mcap.source import ByteSource
from rsltrace.trace.mcap.walk import read_body

_FOOTER = struct.Struct("<QQI")
_FOOTER_BYTES = RECORD_HEAD.size + _FOOTER.size
_BEFORE_CRC = RECORD_HEAD.size + 16
_DATA_END_BYTES = RECORD_HEAD.size + 4
_BLOCK_BYTES = 1 << 20
_CHUNK_INDEX = int(Opcode.CHUNK_INDEX)
_SCHEMA, _CHANNEL, _STATISTICS = int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.STATISTICS)
_ATTACHMENT_INDEX, _METADATA_INDEX = int(Opcode.ATTACHMENT_INDEX), int(Opcode.METADATA_INDEX)


class Footer(NamedTuple):
    """Where the footer is, where the summary begins (0: there is none), and its CRC (0: none)."""

    offset: int
    summary_start: int
    crc: int


@dataclass(slots=True)
class Summary:
    """What the records of a file say of it: schemas and channels by id, metadata and attachments
    by name.

    The indexes of chunks stay as they are until they are asked for: a long run has thousands.
    """

    _chunk_indexes: list[bytes] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: dict[str, Span] = field(default_factory=dict)
    attachments: dict[str, Span] = field(default_factory=dict)
    statistics: Statistics | None = None

    def add(self, opcode: int, body: bytes) -> None:
        """Take over a record, unless it is the index of a chunk. Raises Damaged."""
        if opcode == _SCHEMA:
            schema = parse_schema(body)
            self.schemas.setdefault(schema.id, schema)
        elif opcode == _CHANNEL:
            channel = parse_channel(body)
            self.channels.setdefault(channel.id, channel)
        elif opcode == _STATISTICS:
            self.statistics = parse_statistics(body)
        elif opcode in (_ATTACHMENT_INDEX, _METADATA_INDEX):
            entry = Fields(body)
            span = Span(entry.u64(), entry.u64())
            if opcode == _ATTACHMENT_INDEX:
                entry.take(24)  # log time, creation time, size
                self.attachments[entry.text()] = span
            else:
                self.metadata[entry.text()] = span

    def chunks(self, channels: frozenset[int] | None = None) -> Iterator[ChunkIndex]:
        """Yield the chunks, or those with messages of some channels. Raises Damaged."""
        for body in self._chunk_indexes:
            if channels is None or not channels.isdisjoint(channels_of_chunk_index(body)):
                yield parse_chunk_index(body)


def has_end(source: ByteSource) -> bool:
    """Return whether the file ends as a finished MCAP file does."""
    size = len(MAGIC)
    if source.size < 2 * size + _FOOTER_BYTES:
        return False
    return source.read_at(source.size - size, size) == MAGIC


def read_header(source: ByteSource) -> tuple[Header, int]:
    """Return the header and the offset behind it. Raises Damaged."""
    offset = len(MAGIC)
    if source.size < offset + RECORD_HEAD.size:
        raise CutOff("it is cut off")
    _, length = RECORD_HEAD.unpack(source.read_at(offset, RECORD_HEAD.size))
    span = Span(offset, RECORD_HEAD.size + length)
    if span.end > source.size:
        raise CutOff("it is cut off")
    return parse_header(read_body(source, span, Opcode.HEADER)), span.end


def read_footer(source: ByteSource) -> Footer:
    """Return the footer of a file that has an end. Raises Damaged."""
    offset = source.size - len(MAGIC) - _FOOTER_BYTES
    body = read_body(source, Span(offset, _FOOTER_BYTES), Opcode.FOOTER)
    start, _, crc = _FOOTER.unpack(body)
    if start and not len(MAGIC) < start <= offset:
        raise Damaged("the summary would be outside of the file")
    return Footer(offset, start, crc)


def read_summary(source: ByteSource, footer: Footer) -> Summary:
    """Return the summary. Raises Damaged."""
    length = footer.offset - footer.summary_start
    if length > SUMMARY_BYTES_MAX:
        raise Damaged(f"it has {length} bytes, more than {SUMMARY_BYTES_MAX}")
    data = source.read_at(footer.summary_start, length + _BEFORE_CRC)
    if footer.crc and crc32(data) != footer.crc:
        raise Damaged("its CRC does not match")
    chunk_indexes: list[bytes] = []
    summary = Summary(chunk_indexes)
    records = data[:length]
    for opcode, start, end in records_in(records):
        if opcode == _CHUNK_INDEX:
            chunk_indexes.append(records[start:end])
        else:
            summary.add(opcode, records[start:end])
    return summary


def data_crc(source: ByteSource, end: int) -> int:
    """Return the CRC-32 of the bytes before ``end``."""
    crc = 0
    for offset in range(0, end, _BLOCK_BYTES):
        crc = crc32(source.read_at(offset, min(_BLOCK_BYTES, end - offset)), crc)
    return crc


def check_data(source: ByteSource, end: int) -> None:
    """Raise Damaged unless the data section, which ends at ``end``, has the CRC it says it has."""
    at = end - _DATA_END_BYTES
    body = read_body(source, Span(at, _DATA_END_BYTES), Opcode.DATA_END)
    if data_crc(source, at) != int.from_bytes(body, "little"):
        raise Damaged("its checksum does not match")
