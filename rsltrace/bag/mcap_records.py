"""The MCAP records a bag reader needs, parsed from bytes with every length checked.

A record that ends early raises ``ValueError``; the caller knows the file and the place.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

MAGIC = b"\x89MCAP0\r\n"

HEADER = 0x01
FOOTER = 0x02
SCHEMA = 0x03
CHANNEL = 0x04
MESSAGE = 0x05
CHUNK = 0x06
CHUNK_INDEX = 0x08
STATISTICS = 0x0B
DATA_END = 0x0F

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of the content, in front of every record."""

MESSAGE_HEAD = struct.Struct("<QHIQQ")
"""A message after its opcode: length, channel, sequence, log time, publish time."""

FOOTER_BYTES = RECORD_HEAD.size + 20 + len(MAGIC)
"""The footer record and the magic: the last bytes of every complete file."""

_CHUNK_HEAD = struct.Struct("<QQQI")
_CHUNK_INDEX = struct.Struct("<QQQQ")
_STATISTICS = struct.Struct("<QHIIIIQQ")
_CHANNEL_NUMBER = struct.Struct("<HQ")


@dataclass(frozen=True, slots=True)
class Schema:
    """The definition of a type."""

    id: int
    name: str
    encoding: str
    text: str


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic with its encoding and metadata."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: dict[str, str]


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """What stands in front of a chunk's compressed records; ``data`` is where these are."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data: slice


@dataclass(frozen=True, slots=True)
class ChunkIndex:
    """Where a chunk is, the times in it, and its channels (none are named if not indexed)."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    index_length: int
    channels: frozenset[int]


@dataclass(frozen=True, slots=True)
class Statistics:
    """Totals of the file; ``counts`` are messages by channel."""

    messages: int
    chunks: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]


class Fields:
    """Reads the fields of one record in order."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def take(self, size: int) -> bytes:
        """Return the next ``size`` bytes."""
        end = self.at + size
        if end > len(self.data):
            raise ValueError(f"a field of {size} bytes runs past the end of its record")
        start, self.at = self.at, end
        return self.data[start:end]

    def unpack(self, layout: struct.Struct) -> tuple[int, ...]:
        """Return the next fields of fixed size."""
        return layout.unpack(self.take(layout.size))

    def integer(self, size: int) -> int:
        """Return the next unsigned integer."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """Return the next length-prefixed text."""
        return self.take(self.integer(4)).decode("utf-8")


def parse_schema(data: bytes) -> Schema:
    """Parse a Schema record."""
    fields = Fields(data)
    return Schema(fields.integer(2), fields.text(), fields.text(), fields.text())


def parse_channel(data: bytes) -> Channel:
    """Parse a Channel record."""
    fields = Fields(data)
    number, schema_id = fields.integer(2), fields.integer(2)
    topic, encoding = fields.text(), fields.text()
    pairs = Fields(fields.take(fields.integer(4)))
    metadata: dict[str, str] = {}
    while pairs.at < len(pairs.data):
        key = pairs.text()
        metadata[key] = pairs.text()
    return Channel(number, schema_id, topic, encoding, metadata)


def parse_chunk_head(data: bytes) -> ChunkHead:
    """Parse a Chunk record up to its data."""
    fields = Fields(data)
    start_ns, end_ns, size, crc = fields.unpack(_CHUNK_HEAD)
    compression, length = fields.text(), fields.integer(8)
    if fields.at + length > len(data):
        raise ValueError(f"the chunk's {length} bytes run past the end of its record")
    return ChunkHead(start_ns, end_ns, size, crc, compression, slice(fields.at, fields.at + length))


def parse_chunk_index(data: bytes) -> ChunkIndex:
    """Parse a ChunkIndex record."""
    fields = Fields(data)
    start_ns, end_ns, offset, length = fields.unpack(_CHUNK_INDEX)
    offsets = fields.take(fields.integer(4))
    channels = frozenset(channel for channel, _ in _CHANNEL_NUMBER.iter_unpack(offsets))
    return ChunkIndex(start_ns, end_ns, offset, length, fields.integer(8), channels)


def parse_statistics(data: bytes) -> Statistics:
    """Parse a Statistics record."""
    fields = Fields(data)
    messages, _, _, _, _, chunks, start_ns, end_ns = fields.unpack(_STATISTICS)
    counts = dict(_CHANNEL_NUMBER.iter_unpack(fields.take(fields.integer(4))))
    return Statistics(messages, chunks, start_ns, end_ns, counts)
