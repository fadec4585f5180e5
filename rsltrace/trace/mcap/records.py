"""The records of MCAP, parsed from bytes that may be damaged or hostile.

The ``mcap`` package trusts lengths and loads that much, and importing its records takes longer than
opening a trace. Here every length is checked before it is used.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache, lru_cache
from typing import NamedTuple

from mcap.opcode import Opcode

try:
    from zlib_ng.zlib_ng import crc32 as crc32  # carry-less multiplication: 10 times as fast
except ImportError:  # a sourced ROS 2 with its own Python may not have it
    from zlib import crc32 as crc32

_POLYNOMIAL = 0xEDB88320
_ONE = 1 << 31
"""CRCs are polynomials over GF(2) whose highest bit is the constant term."""


def joined_crc(first: int, second: int, length: int) -> int:
    """Return the CRC-32 of two pieces in sequence; the second has ``length`` bytes.

    Takes some 5 microseconds, and as much for each set bit of a new length.
    """
    return _product(first, _zeros(length)) ^ second


def crc_of(parts: tuple[bytes, ...]) -> int:
    """Return the CRC-32 of all parts in sequence."""
    crc = 0
    for part in parts:
        crc = crc32(part, crc)
    return crc


@lru_cache(maxsize=64)
def _zeros(length: int) -> int:
    """Return the factor of a CRC to which ``length`` zero bytes are appended."""
    factor, power = _ONE, 0
    while length >> power:
        if length >> power & 1:
            factor = _product(factor, _power(power))
        power += 1
    return factor


@cache
def _power(power: int) -> int:
    """Return the factor of 2 ** power zero bytes."""
    if power == 0:
        return _ONE >> 8
    return _product(_power(power - 1), _power(power - 1))


def _product(first: int, second: int) -> int:
    result = 0
    while first:
        if first & _ONE:
            result ^= second
        first = first << 1 & 0xFFFFFFFF
        second = second >> 1 ^ (_POLYNOMIAL if second & 1 else 0)
    return result


# Limits on what is read from a file or a server. Anybody may have written it. The limits hold for
# traces and bags, are far above real ones, and bound memory and time. ``docs/trace-format.md``
# lists them.

MESSAGE_BYTES_MAX = 512 << 20
"""The largest message of a trace or a bag."""

CHUNK_BYTES_MAX = MESSAGE_BYTES_MAX + (1 << 20)
"""The largest chunk after decompression: one such message and the messages before it."""

RECORD_BYTES_MAX = CHUNK_BYTES_MAX + (1 << 20)
"""The largest record that is read at once."""

SUMMARY_BYTES_MAX = 256 << 20
"""Four times the summary of a trace of a thousand million events."""

ENTITY_ID_MAX = 1 << 24
"""Ids count up, but not every entity with one is in the trace. A diff makes a table by id."""

FILE_GROWTH_MAX = 1000
FILE_BYTES_MIN = 1 << 30
"""A compressed bag file may grow by the first factor, and always to the second size."""

METADATA_YAML_BYTES_MAX = 4 << 20
"""Some 4000 topics with QoS; parsing takes 60 times the memory, and 3 µs per byte."""

SCHEMA_BYTES_MAX = 256 << 10
"""For one type and its dependencies; parsing takes some 8 µs per character."""

SCHEMAS_BYTES_MAX = 4 << 20
"""For all types decoded from one trace."""

SCHEMA_ITEMS_MAX = 4096
SCHEMAS_ITEMS_MAX = 16384
"""Items of all fixed arrays of strings or messages, in a schema and in all decoded ones: each
becomes lines of code, and a thousand take a second."""

RESPONSE_BYTES_MAX = 64 << 20
"""A server without ranges sends the whole file; larger files must be downloaded first."""

REQUEST_SECONDS_MAX = 60.0
"""For one request to a server."""

REMOTE_SECONDS_MAX = 600.0
"""For all requests of one open file."""


MAGIC = b"\x89MCAP0\r\n"
SCHEMA_ENCODING = "ros2msg"
MESSAGE_ENCODING = "cdr"

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and body length, before every record."""

MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""A message up to its data: opcode, length, channel, sequence, log time, publish time."""

MESSAGE = int(Opcode.MESSAGE)

_HEAD_BYTES = RECORD_HEAD.size
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_CHUNK_INDEX_HEAD = struct.Struct("<QQQQI")
_CHANNEL_NUMBER = struct.Struct("<HQ")


class DamageError(ValueError):
    """The bytes are not what they should be. Callers that know the file add its name."""


class TruncatedFile(DamageError):
    """The file ends too early."""


class RecordSpan(NamedTuple):
    """The place of a whole record in the file, opcode and length included."""

    offset: int
    length: int

    @property
    def end(self) -> int:
        return self.offset + self.length


class RecordFields:
    """Reads fields from the front of a record's body; at its end, all methods raise DamageError."""

    __slots__ = ("_data", "position")

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.position = 0

    @property
    def at_end(self) -> bool:
        return self.position == len(self._data)

    def take(self, length: int) -> bytes:
        begin = self.position
        end = begin + length
        if end > len(self._data):
            raise self._ended(length)
        self.position = end
        return self._data[begin:end]

    def u16(self) -> int:
        return self._integer(_U16)

    def u32(self) -> int:
        return self._integer(_U32)

    def u64(self) -> int:
        return self._integer(_U64)

    def text(self) -> str:
        begin = self.position + 4
        end = begin + self._integer(_U32)
        if end > len(self._data):
            raise self._ended(end - begin)
        self.position = end
        try:
            return self._data[begin:end].decode()
        except UnicodeDecodeError as error:
            raise DamageError(f"a text is not UTF-8: {error}") from error

    def mapping(self) -> dict[str, str]:
        inner = RecordFields(self.take(self.u32()))
        result = {}
        while not inner.at_end:
            key = inner.text()
            result[key] = inner.text()
        return result

    def numbers(self) -> list[tuple[int, int]]:
        """Return the next map from channels to numbers."""
        data = self.take(self.u32())
        if len(data) % _CHANNEL_NUMBER.size:
            raise DamageError("a map is cut off")
        return list(_CHANNEL_NUMBER.iter_unpack(data))

    def _integer(self, layout: struct.Struct) -> int:
        try:
            (value,) = layout.unpack_from(self._data, self.position)
        except struct.error:
            raise self._ended(layout.size) from None
        self.position += layout.size
        return int(value)

    def _ended(self, length: int) -> DamageError:
        left = len(self._data) - self.position
        return DamageError(f"{length} bytes are expected where {left} are left")


class McapHeader(NamedTuple):
    """The first record of the file: the profile (``ros2``) and the writing library."""

    profile: str
    library: str


class McapSchema(NamedTuple):
    """The definition of a type."""

    id: int
    name: str
    encoding: str
    text: str


class McapChannel(NamedTuple):
    """A topic with its encoding and metadata."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: dict[str, str]


class McapStatistics(NamedTuple):
    """Totals of the file; ``counts`` are messages by channel."""

    messages: int
    chunks: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]


class ChunkIndexEntry(NamedTuple):
    """The place and times of a chunk. ``indexes`` are the offsets of its message indexes by
    channel, ``end`` is behind the last of them."""

    start_ns: int
    end_ns: int
    span: RecordSpan
    indexes: dict[int, int]
    end: int


def parse_header(body: bytes) -> McapHeader:
    """Parse a Header record. All parsers raise DamageError."""
    fields = RecordFields(body)
    return McapHeader(fields.text(), fields.text())


def parse_schema(body: bytes) -> McapSchema:
    fields = RecordFields(body)
    return McapSchema(fields.u16(), fields.text(), fields.text(), fields.text())


def parse_channel(body: bytes) -> McapChannel:
    fields = RecordFields(body)
    channel_id, schema_id = fields.u16(), fields.u16()
    return McapChannel(channel_id, schema_id, fields.text(), fields.text(), fields.mapping())


def parse_statistics(body: bytes) -> McapStatistics:
    fields = RecordFields(body)
    messages = fields.u64()
    fields.take(14)  # how many schemas, channels, attachments and metadata records there are
    chunks, start_ns, end_ns = fields.u32(), fields.u64(), fields.u64()
    return McapStatistics(messages, chunks, start_ns, end_ns, dict(fields.numbers()))


def parse_chunk_index(body: bytes) -> ChunkIndexEntry:
    if len(body) < _CHUNK_INDEX_HEAD.size:
        raise DamageError("an entry of the list of chunks is cut off")
    start_ns, end_ns, offset, length, size = _CHUNK_INDEX_HEAD.unpack_from(body)
    entries_end = _CHUNK_INDEX_HEAD.size + size
    if size % _CHANNEL_NUMBER.size or entries_end + _U64.size > len(body):
        raise DamageError("an entry of the list of chunks is cut off")
    indexes = dict(_CHANNEL_NUMBER.iter_unpack(body[_CHUNK_INDEX_HEAD.size : entries_end]))
    end = offset + length + _U64.unpack_from(body, entries_end)[0]
    return ChunkIndexEntry(start_ns, end_ns, RecordSpan(offset, length), indexes, end)


def records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end) of the bodies of the records in ``data``. Raises DamageError."""
    at, size, unpack = 0, len(data), RECORD_HEAD.unpack_from
    while at < size:
        if at + _HEAD_BYTES > size:
            raise DamageError("a record runs past the end of its chunk")
        opcode, length = unpack(data, at)
        start = at + _HEAD_BYTES
        at = start + length
        if at > size:
            raise DamageError("a record runs past the end of its chunk")
        yield opcode, start, at
