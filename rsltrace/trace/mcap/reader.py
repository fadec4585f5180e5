"""Read the structure of an MCAP file: records one by one, header, footer and summary."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import field
from typing import NamedTuple

from mcap.opcode import Opcode

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.mcap.records import (
    MAGIC,
    RECORD_BYTES_MAX,
    RECORD_HEAD,
    SUMMARY_BYTES_MAX,
    ChunkIndexEntry,
    DamageError,
    McapChannel,
    McapHeader,
    McapSchema,
    McapStatistics,
    RecordFields,
    RecordSpan,
    TruncatedFile,
    crc32,
    parse_channel,
    parse_chunk_index,
    parse_header,
    parse_schema,
    parse_statistics,
    records_in,
)
from rsltrace.trace.mcap.source import ByteSource

_BLOCK_BYTES = 1 << 20
_TAIL_BYTES = 64 << 10
_KNOWN = frozenset(map(int, Opcode))


def read_body(source: ByteSource, span: RecordSpan, opcode: int) -> bytes:
    """Return the body of the record at ``span``. Raises DamageError if it is another record."""
    if not RECORD_HEAD.size <= span.length <= RECORD_BYTES_MAX:
        raise DamageError(f"its length is given as {span.length}")
    record = source.read_at(*span)
    found, length = RECORD_HEAD.unpack_from(record)
    if found != opcode or length + RECORD_HEAD.size != span.length:
        raise DamageError("another record is there")
    return record[RECORD_HEAD.size :]


def walk_records(source: ByteSource, start: int, end: int) -> Iterator[tuple[int, RecordSpan]]:
    """Yield opcode and span of the records between two offsets.

    Raises DamageError at a record that is not whole.
    """
    at = start
    while at < end:
        if at + RECORD_HEAD.size > end:
            raise DamageError(f"the record at byte {at} is cut off")
        opcode, length = RECORD_HEAD.unpack(source.read_at(at, RECORD_HEAD.size))
        span = RecordSpan(at, length + RECORD_HEAD.size)
        if span.end > end:
            raise DamageError(f"the record at byte {at} runs past the end of its section")
        yield opcode, span
        at = span.end


def whole_records(source: ByteSource) -> Iterator[tuple[int, RecordSpan]]:
    """Yield the whole records of a file without an end.

    Raises DamageError unless the rest is the beginning of one more record: a truncated file ends
    inside a record, or in zeros that a crash leaves.
    """
    at = len(MAGIC)
    try:
        for opcode, span in walk_records(source, at, source.size):
            if opcode not in _KNOWN:
                break
            yield opcode, span
            at = span.end
    except DamageError:
        pass  # where it was cut, or is damaged
    if why := _damage_at(source, at):
        raise DamageError(why)


def _damage_at(source: ByteSource, at: int) -> str:
    """Return why the rest of a file is not the beginning of a record, "" if it is."""
    rest = source.size - at
    head = source.read_at(at, min(rest, _TAIL_BYTES))
    if not any(head):
        return "" if _is_zero(source, at + len(head)) else "there are zeros where a record begins"
    if rest < RECORD_HEAD.size:
        return ""
    opcode, length = RECORD_HEAD.unpack_from(head)
    if opcode not in _KNOWN:
        return f"no record of MCAP begins with {opcode}"
    said = length_by_fields(opcode, head[RECORD_HEAD.size :])
    if said is not None and said != length:
        return f"its length is given as {length}, its fields say {said}"
    return ""


def _is_zero(source: ByteSource, at: int) -> bool:
    for offset in range(at, source.size, _BLOCK_BYTES):
        if any(source.read_at(offset, min(_BLOCK_BYTES, source.size - offset))):
            return False
    return True


_BEFORE_TEXTS = {
    Opcode.HEADER: (0, 2),
    Opcode.SCHEMA: (2, 3),
    Opcode.CHANNEL: (4, 3),
    Opcode.CHUNK: (28, 1),
    Opcode.MESSAGE_INDEX: (2, 1),
    Opcode.ATTACHMENT: (16, 2),
    Opcode.METADATA: (0, 2),
}
"""By opcode: the number of bytes before the first text (or map, which also has a length), and of
texts in sequence."""


def length_by_fields(opcode: int, body: bytes) -> int | None:
    """Return the length of a record as its fields say, None where they are cut off."""
    if opcode not in _BEFORE_TEXTS:
        return None
    fixed, texts = _BEFORE_TEXTS[Opcode(opcode)]
    fields = RecordFields(body)
    try:
        fields.take(fixed)
        for number in range(texts):
            length = fields.u32()
            if number + 1 == texts and opcode not in (Opcode.CHUNK, Opcode.ATTACHMENT):
                return fields.position + length
            fields.take(length)
        length = fields.u64()
    except DamageError:
        return None
    return fields.position + length + (4 if opcode == Opcode.ATTACHMENT else 0)


_FOOTER = struct.Struct("<QQI")
_FOOTER_BYTES = RECORD_HEAD.size + _FOOTER.size
_BEFORE_CRC = RECORD_HEAD.size + 16
_DATA_END_BYTES = RECORD_HEAD.size + 4
_CHUNK_INDEX = int(Opcode.CHUNK_INDEX)
_SCHEMA, _CHANNEL, _STATISTICS = int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.STATISTICS)
_ATTACHMENT_INDEX, _METADATA_INDEX = int(Opcode.ATTACHMENT_INDEX), int(Opcode.METADATA_INDEX)


class McapFooter(NamedTuple):
    """The offset of the footer, of the summary (0: none), and the summary's CRC (0: none)."""

    offset: int
    summary_start: int
    crc: int


@dataclass
class McapSummary:
    """What a file's records say: schemas and channels by id, metadata and attachments by name.

    Chunk indexes are parsed only when needed: a long run has thousands.
    """

    _chunk_indexes: list[bytes] = field(default_factory=list)
    schemas: dict[int, McapSchema] = field(default_factory=dict)
    channels: dict[int, McapChannel] = field(default_factory=dict)
    metadata: dict[str, RecordSpan] = field(default_factory=dict)
    attachments: dict[str, RecordSpan] = field(default_factory=dict)
    statistics: McapStatistics | None = None

    def add(self, opcode: int, body: bytes) -> None:
        """Add a record other than a chunk index. Raises DamageError."""
        if opcode == _SCHEMA:
            schema = parse_schema(body)
            self.schemas.setdefault(schema.id, schema)
        elif opcode == _CHANNEL:
            channel = parse_channel(body)
            self.channels.setdefault(channel.id, channel)
        elif opcode == _STATISTICS:
            self.statistics = parse_statistics(body)
        elif opcode in (_ATTACHMENT_INDEX, _METADATA_INDEX):
            entry = RecordFields(body)
            span = RecordSpan(entry.u64(), entry.u64())
            if opcode == _ATTACHMENT_INDEX:
                entry.take(24)  # log time, creation time, size
                self.attachments[entry.text()] = span
            else:
                self.metadata[entry.text()] = span

    def chunks(self) -> Iterator[ChunkIndexEntry]:
        """Yield the chunks. Raises DamageError."""
        yield from map(parse_chunk_index, self._chunk_indexes)


def has_end(source: ByteSource) -> bool:
    """Return whether the file ends like a finished MCAP file."""
    size = len(MAGIC)
    if source.size < 2 * size + _FOOTER_BYTES:
        return False
    return source.read_at(source.size - size, size) == MAGIC


def read_header(source: ByteSource) -> tuple[McapHeader, int]:
    """Return the header and the offset behind it. Raises DamageError."""
    offset = len(MAGIC)
    if source.size < offset + RECORD_HEAD.size:
        raise TruncatedFile("it is cut off")
    _, length = RECORD_HEAD.unpack(source.read_at(offset, RECORD_HEAD.size))
    span = RecordSpan(offset, RECORD_HEAD.size + length)
    if span.end > source.size:
        raise TruncatedFile("it is cut off")
    return parse_header(read_body(source, span, Opcode.HEADER)), span.end


def read_footer(source: ByteSource) -> McapFooter:
    """Return the footer of a file that has an end. Raises DamageError."""
    offset = source.size - len(MAGIC) - _FOOTER_BYTES
    body = read_body(source, RecordSpan(offset, _FOOTER_BYTES), Opcode.FOOTER)
    start, _, crc = _FOOTER.unpack(body)
    if start and not len(MAGIC) < start <= offset:
        raise DamageError("the summary would be outside of the file")
    return McapFooter(offset, start, crc)


def read_summary(source: ByteSource, footer: McapFooter) -> McapSummary:
    length = footer.offset - footer.summary_start
    if length > SUMMARY_BYTES_MAX:
        raise DamageError(f"it has {length} bytes, more than {SUMMARY_BYTES_MAX}")
    data = source.read_at(footer.summary_start, length + _BEFORE_CRC)
    if footer.crc and crc32(data) != footer.crc:
        raise DamageError("its CRC does not match")
    chunk_indexes: list[bytes] = []
    summary = McapSummary(chunk_indexes)
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
    """Raise DamageError unless the data section that ends at ``end`` matches its CRC."""
    at = end - _DATA_END_BYTES
    body = read_body(source, RecordSpan(at, _DATA_END_BYTES), Opcode.DATA_END)
    if data_crc(source, at) != int.from_bytes(body, "little"):
        raise DamageError("its checksum does not match")
