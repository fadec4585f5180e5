"""The records of MCAP, taken from bytes that may be damaged or hostile.

The ``mcap`` package trusts lengths and loads what they say, and importing its records takes longer
than opening a trace. Here every length is checked against what is there before it is used.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode

# The header of an MCAP message as numpy sees it: ``records.MESSAGE_HEAD`` is the same.

MESSAGE_HEADER_DTYPE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel_id", "<u2"),
        ("message_sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
"""``message_sequence`` is what MCAP calls ``sequence``: messages have fields of
that name, too, and may stand in one layout with it."""


# How much of anything is read from a file or a server before it is refused.
#
# What is in a file was written by anybody. These limits hold for traces and for bags; they are far
# above what either has, and keep memory and time within what the file is asked for.
# ``docs/trace-format.md`` states them for people.

MESSAGE_BYTES_MAX = 512 << 20
"""The largest message that is recorded in a trace, and taken from a bag."""

CHUNK_BYTES_MAX = MESSAGE_BYTES_MAX + (1 << 20)
"""What a chunk may unpack to: one such message, and what was gathered before it."""

RECORD_BYTES_MAX = CHUNK_BYTES_MAX + (1 << 20)
"""The largest record that is read at once, as it stands in the file."""

SUMMARY_BYTES_MAX = 256 << 20
"""The summary of a trace of a thousand million events has a quarter of this."""

ENTITY_ID_MAX = 1 << 24
"""Ids count up, but not all that have one are in the trace. A diff makes a table by id."""

FILE_GROWTH_MAX = 1000
FILE_BYTES_MIN = 1 << 30
"""A compressed bag file may unpack to so many times its size, and always to so much."""

METADATA_YAML_BYTES_MAX = 4 << 20
"""Some 4000 topics and their QoS; parsing takes 60 times as much memory, and 3 µs per byte."""

SCHEMA_BYTES_MAX = 256 << 10
"""Of one type with all it depends on; parsing takes some 8 µs per character."""

SCHEMAS_BYTES_MAX = 4 << 20
"""Of all types that are decoded of one trace."""

SCHEMA_ITEMS_MAX = 4096
SCHEMAS_ITEMS_MAX = 16384
"""Items of all fixed arrays of strings or messages, in a schema and in all that are decoded of one
trace: each becomes lines of code, and a thousand of them take a second."""

RESPONSE_BYTES_MAX = 64 << 20
"""A server may know no ranges and send all; what is larger has to be downloaded by its owner."""

REQUEST_SECONDS_MAX = 60.0
"""For one request to a server, however it spends them."""

REMOTE_SECONDS_MAX = 600.0
"""For all requests of one open file together."""


MAGIC = b"\x89MCAP0\r\n"
SCHEMA_ENCODING = "ros2msg"
MESSAGE_ENCODING = "cdr"

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of the body, in front of every record."""

MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""A message up to its data: opcode, length, channel, sequence, log time, publish time."""

MESSAGE = int(Opcode.MESSAGE)

_HEAD_BYTES = RECORD_HEAD.size
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_CHUNK_INDEX_HEAD = struct.Struct("<QQQQI")
_CHANNEL_NUMBER = struct.Struct("<HQ")


class Damaged(ValueError):
    """The bytes are not what they should be. Who knows the file makes an error of it."""


class CutOff(Damaged):
    """There is less of the file than of what should be in it."""


class Span(NamedTuple):
    """A whole record in the file, opcode and length included: where it is, and its bytes."""

    offset: int
    length: int

    @property
    def end(self) -> int:
        """The offset behind it."""
        return self.offset + self.length


class Fields:
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
        begin = self.position
        end = begin + length
        if end > len(self._data):
            raise self._ended(length)
        self.position = end
        return self._data[begin:end]

    def u16(self) -> int:
        """Return the next unsigned 16-bit integer."""
        return self._integer(_U16)

    def u32(self) -> int:
        """Return the next unsigned 32-bit integer."""
        return self._integer(_U32)

    def u64(self) -> int:
        """Return the next unsigned 64-bit integer."""
        return self._integer(_U64)

    def text(self) -> str:
        """Return the next string."""
        begin = self.position + 4
        end = begin + self._integer(_U32)
        if end > len(self._data):
            raise self._ended(end - begin)
        self.position = end
        try:
            return self._data[begin:end].decode()
        except UnicodeDecodeError as error:
            raise Damaged(f"a text is not UTF-8: {error}") from error

    def mapping(self) -> dict[str, str]:
        """Return the next map of strings."""
        inner = Fields(self.take(self.u32()))
        result = {}
        while not inner.at_end:
            key = inner.text()
            result[key] = inner.text()
        return result

    def numbers(self) -> list[tuple[int, int]]:
        """Return the next map of a number by channel."""
        data = self.take(self.u32())
        if len(data) % _CHANNEL_NUMBER.size:
            raise Damaged("a map is cut off")
        return list(_CHANNEL_NUMBER.iter_unpack(data))

    def _integer(self, layout: struct.Struct) -> int:
        try:
            (value,) = layout.unpack_from(self._data, self.position)
        except struct.error:
            raise self._ended(layout.size) from None
        self.position += layout.size
        return int(value)

    def _ended(self, length: int) -> Damaged:
        left = len(self._data) - self.position
        return Damaged(f"{length} bytes are expected where {left} are left")


class Header(NamedTuple):
    """The first record of the file: the profile (``ros2``) and what wrote it."""

    profile: str
    library: str


class Schema(NamedTuple):
    """The definition of a type."""

    id: int
    name: str
    encoding: str
    text: str


class Channel(NamedTuple):
    """A topic with its encoding and metadata."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: dict[str, str]


class Statistics(NamedTuple):
    """Totals of the file; ``counts`` are messages by channel."""

    messages: int
    chunks: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]


class ChunkIndex(NamedTuple):
    """Where a chunk is and the times in it. ``indexes`` says where its channels' indexes begin (of
    none, if it has none), and ``end`` where the last of them is over."""

    start_ns: int
    end_ns: int
    span: Span
    indexes: list[tuple[int, int]]
    end: int


def parse_header(body: bytes) -> Header:
    """Parse a Header record. Raises Damaged, as all of these do."""
    fields = Fields(body)
    return Header(fields.text(), fields.text())


def parse_schema(body: bytes) -> Schema:
    """Parse a Schema record."""
    fields = Fields(body)
    return Schema(fields.u16(), fields.text(), fields.text(), fields.text())


def parse_channel(body: bytes) -> Channel:
    """Parse a Channel record."""
    fields = Fields(body)
    channel_id, schema_id = fields.u16(), fields.u16()
    return Channel(channel_id, schema_id, fields.text(), fields.text(), fields.mapping())


def parse_statistics(body: bytes) -> Statistics:
    """Parse a Statistics record."""
    fields = Fields(body)
    messages = fields.u64()
    fields.take(14)  # how many schemas, channels, attachments and metadata records there are
    chunks, start_ns, end_ns = fields.u32(), fields.u64(), fields.u64()
    return Statistics(messages, chunks, start_ns, end_ns, dict(fields.numbers()))


def parse_chunk_index(body: bytes) -> ChunkIndex:
    """Parse a ChunkIndex record."""
    if len(body) < _CHUNK_INDEX_HEAD.size:
        raise Damaged("an entry of the list of chunks is cut off")
    start_ns, end_ns, offset, length, size = _CHUNK_INDEX_HEAD.unpack_from(body)
    entries_end = _CHUNK_INDEX_HEAD.size + size
    if size % _CHANNEL_NUMBER.size or entries_end + _U64.size > len(body):
        raise Damaged("an entry of the list of chunks is cut off")
    indexes = list(_CHANNEL_NUMBER.iter_unpack(body[_CHUNK_INDEX_HEAD.size : entries_end]))
    end = offset + length + _U64.unpack_from(body, entries_end)[0]
    return ChunkIndex(start_ns, end_ns, Span(offset, length), indexes, end)


def channels_of_chunk_index(body: bytes) -> list[int]:
    """Return the channels of a ChunkIndex, and nothing else of it: of thousands few are wanted."""
    if len(body) > _CHUNK_INDEX_HEAD.size + _CHANNEL_NUMBER.size:
        (size,) = _U32.unpack_from(body, _CHUNK_INDEX_HEAD.size - _U32.size)
        if size == _CHANNEL_NUMBER.size:  # events or outputs: most chunks
            return [_U16.unpack_from(body, _CHUNK_INDEX_HEAD.size)[0]]
    return [channel_id for channel_id, _ in parse_chunk_index(body).indexes]


def records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end) of the bodies of the records in ``data``. Raises Damaged."""
    at, size, unpack = 0, len(data), RECORD_HEAD.unpack_from
    while at < size:
        if at + _HEAD_BYTES > size:
            raise Damaged("a record runs past the end of its chunk")
        opcode, length = unpack(data, at)
        start = at + _HEAD_BYTES
        at = start + length
        if at > size:
            raise Damaged("a record runs past the end of its chunk")
        yield opcode, start, at
