"""Reading MCAP records from bytes that may be damaged or hostile.

The ``mcap`` package trusts lengths and loads what they say; a trace comes from anywhere and may be
cut, so every length here is checked against what is there before it is used.
"""

from __future__ import annotations

import struct
from binascii import crc32
from collections.abc import Iterator
from typing import NamedTuple

import zstandard
from mcap.opcode import Opcode

from rsltrace.errors import TraceError
from rsltrace.trace.source import ByteSource

RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_CHUNK_BYTES_MAX = 1 << 32
_MESSAGE = int(Opcode.MESSAGE)
_MESSAGE_FIXED = MESSAGE_HEAD.size - RECORD_HEAD.size


class Damaged(ValueError):
    """The bytes are not what they should be. Callers turn it into a TraceError that says where."""


class Span(NamedTuple):
    """A whole record in the file, opcode and length included: where it is, and its bytes."""

    offset: int
    length: int


class Cursor:
    """Takes fields off the front of a record's body. Every method raises Damaged at its end."""

    __slots__ = ("_data", "position")

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.position = 0

    @property
    def at_end(self) -> bool:
        """Whether everything was taken."""
        return self.position == len(self._data)

    def take(self, length: int) -> bytes:
        """Return the next ``length`` bytes."""
        end = self.position + length
        if end > len(self._data):
            left = len(self._data) - self.position
            raise Damaged(f"{length} bytes are expected where {left} are left")
        piece = self._data[self.position : end]
        self.position = end
        return piece

    def u16(self) -> int:
        """Return the next unsigned 16-bit integer."""
        return int(_U16.unpack(self.take(2))[0])

    def u32(self) -> int:
        """Return the next unsigned 32-bit integer."""
        return int(_U32.unpack(self.take(4))[0])

    def u64(self) -> int:
        """Return the next unsigned 64-bit integer."""
        return int(_U64.unpack(self.take(8))[0])

    def text(self) -> str:
        """Return the next string."""
        try:
            return self.take(self.u32()).decode("utf-8")
        except UnicodeDecodeError as error:
            raise Damaged(f"a text is not UTF-8: {error}") from error

    def mapping(self) -> dict[str, str]:
        """Return the next map of strings."""
        inner = Cursor(self.take(self.u32()))
        result = {}
        while not inner.at_end:
            key = inner.text()
            result[key] = inner.text()
        return result

    def integers(self, layout: str) -> list[tuple[int, ...]]:
        """Return the next array, whose elements have the struct ``layout``."""
        data = self.take(self.u32())
        try:
            return list(struct.iter_unpack(layout, data))
        except struct.error as error:
            raise Damaged("an array is cut off") from error


class MessageView(NamedTuple):
    """A message in a chunk: header fields, and where its data lies in the chunk's records."""

    channel_id: int
    sequence: int
    log_time: int
    start: int
    end: int


def damaged(source: ByteSource, offset: int, what: str, why: object) -> TraceError:
    """Return the error for damage found at ``offset`` of the file."""
    return TraceError(
        f"{source.name}: {what} at offset {offset} is damaged ({why}); "
        "copy the file again or record it again"
    )


def read_head(source: ByteSource, offset: int) -> tuple[int, int]:
    """Return (opcode, length of the whole record) of the record at ``offset``."""
    opcode, length = RECORD_HEAD.unpack(source.read_at(offset, RECORD_HEAD.size))
    return opcode, length + RECORD_HEAD.size


def read_body(source: ByteSource, span: Span, opcode: int, what: str) -> bytes:
    """Return the body of the record at ``span``. Raises TraceError if it is not such a record."""
    if span.length < RECORD_HEAD.size:
        raise damaged(source, span.offset, what, f"its length is given as {span.length}")
    record = source.read_at(*span)
    found, length = RECORD_HEAD.unpack_from(record)
    if found != opcode or length + RECORD_HEAD.size != span.length:
        raise damaged(source, span.offset, what, "another record is there")
    return record[RECORD_HEAD.size :]


def read_chunk(source: ByteSource, span: Span) -> bytes:
    """Return the records of the chunk at ``span``, their CRC checked. Raises TraceError."""
    body = read_body(source, span, Opcode.CHUNK, "the chunk")
    try:
        cursor = Cursor(body)
        _, _, size, crc = _CHUNK_HEAD.unpack(cursor.take(_CHUNK_HEAD.size))
        compression = cursor.text()
        data = cursor.take(cursor.u64())
        if not cursor.at_end:
            raise Damaged("it is longer than its data")
        return _checked(_decompressed(data, compression, size), size, crc)
    except Damaged as error:
        raise damaged(source, span.offset, "the chunk", error) from error


def _decompressed(data: bytes, compression: str, size: int) -> bytes:
    if compression == "":
        return data
    if compression != "zstd":
        raise Damaged(f"its compression is {compression!r}, a trace has 'zstd' or none")
    try:
        # The size is compared before anything is unpacked: a small file can ask for much memory.
        if zstandard.frame_content_size(data) != size or size > _CHUNK_BYTES_MAX:
            raise Damaged(f"it does not unpack to {size} bytes")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    except (zstandard.ZstdError, MemoryError) as error:
        raise Damaged(f"it does not unpack: {error}") from error


def _checked(records: bytes, size: int, crc: int) -> bytes:
    if len(records) != size:
        raise Damaged(f"it has {len(records)} bytes instead of {size}")
    # MCAP lets a writer leave the CRC out by writing 0. Ours never does: 0 is compared like any.
    if crc32(records) != crc:
        raise Damaged("its checksum does not match")
    return records


def message_at(records: bytes, offset: int) -> MessageView:
    """Return the message record at ``offset`` of a chunk. Raises Damaged if there is none."""
    if offset + MESSAGE_HEAD.size > len(records):
        raise Damaged(f"no message fits at {offset} of the chunk")
    opcode, length, channel_id, sequence, log_time, _ = MESSAGE_HEAD.unpack_from(records, offset)
    end = offset + RECORD_HEAD.size + length
    if opcode != _MESSAGE or length < _MESSAGE_FIXED or end > len(records):
        raise Damaged(f"there is no whole message at {offset} of the chunk")
    return MessageView(channel_id, sequence, log_time, offset + MESSAGE_HEAD.size, end)


def walk_messages(records: bytes) -> Iterator[tuple[int, MessageView]]:
    """Yield (offset, message) for each message of a chunk, in order. Raises Damaged."""
    offset = 0
    while offset < len(records):
        if records[offset] == _MESSAGE:
            message = message_at(records, offset)
            yield offset, message
            offset = message.end
        else:  # a schema or channel, which MCAP allows in chunks
            if offset + RECORD_HEAD.size > len(records):
                raise Damaged(f"a record is cut off at {offset} of the chunk")
            _, length = RECORD_HEAD.unpack_from(records, offset)
            offset += RECORD_HEAD.size + length
    if offset != len(records):
        raise Damaged("its last record is cut off")
