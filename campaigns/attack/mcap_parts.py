"""An MCAP file taken apart into its records, to be changed and put together again.

Put together means repaired, too: offsets, lengths and checksums are those of the new file, so that
a change is found where it is and not at the first checksum. ``was`` is where a record stood, which
is how indexes find it again. Nothing here is rsltrace's: the records are the ``mcap`` package's.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from itertools import chain, takewhile

import lz4.frame
import xxhash
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
SEGMENT_ROW = struct.Struct("<11Q")
CDR = b"\x00\x01\x00\x00"
MESSAGE_HEAD = struct.Struct("<HIQQ")

_CLASSES = {
    Opcode.HEADER: records.Header,
    Opcode.FOOTER: records.Footer,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.CHUNK: records.Chunk,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.ATTACHMENT: records.Attachment,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
    Opcode.STATISTICS: records.Statistics,
    Opcode.METADATA: records.Metadata,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    Opcode.DATA_END: records.DataEnd,
}


@dataclass
class Part:
    """One record. ``length`` is what the file says of it, if that is not its length."""

    opcode: int
    body: bytes
    was: int = -1
    length: int | None = None

    @property
    def record(self) -> records.McapRecord:
        """The record as the mcap package reads it."""
        stream = ReadDataStream(BytesIO(self.body))
        found = _CLASSES[Opcode(self.opcode)]
        if found is records.Schema:
            return records.Schema.read(stream)
        return found.read(stream)  # type: ignore[attr-defined,no-any-return]

    @record.setter
    def record(self, record: records.McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self.body = bytes(builder.end())[HEAD.size :]

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return HEAD.size + len(self.body)

    @property
    def bytes(self) -> bytes:
        """The record as it stands in the file."""
        length = len(self.body) if self.length is None else self.length
        return HEAD.pack(self.opcode, length % 2**64) + self.body


def take_apart(data: bytes) -> list[Part]:
    """Return the records of a whole file."""
    parts = []
    at = len(MAGIC)
    while at < len(data) - len(MAGIC):
        opcode, length = HEAD.unpack_from(data, at)
        parts.append(Part(opcode, data[at + HEAD.size : at + HEAD.size + length], at))
        at += HEAD.size + length
    return parts


def put_together(parts: list[Part], *, repair: bool = True) -> bytes:
    """Return a file of these records; with ``repair``, one in which they find each other."""
    if repair:
        _repair(parts)
    return b"".join((MAGIC, *(part.bytes for part in parts), MAGIC))


def _repair(parts: list[Part]) -> None:
    at = len(MAGIC)
    places: dict[int, int] = {}
    sizes: dict[int, int] = {}
    groups: dict[int, list[int]] = {}
    summary = offsets = data_end = None
    for part in parts:
        if part.was >= 0:
            places.setdefault(part.was, at)
            sizes.setdefault(part.was, part.size)
        if part.opcode == Opcode.DATA_END:
            data_end = at
            summary = at + part.size
        elif summary is not None and part.opcode == Opcode.SUMMARY_OFFSET and offsets is None:
            offsets = at
        elif summary is not None and part.opcode != Opcode.FOOTER:
            groups.setdefault(part.opcode, [at, 0])[1] += part.size
        at += part.size
    for part in parts:
        _relocate(part, places, sizes, groups)
    if data_end is not None and summary is not None:
        _checksums(parts, summary, offsets or 0)


def _relocate(
    part: Part, places: dict[int, int], sizes: dict[int, int], groups: dict[int, list[int]]
) -> None:
    if part.opcode == Opcode.CHUNK_INDEX:
        record = part.record
        assert isinstance(record, records.ChunkIndex)
        was = record.chunk_start_offset
        record.chunk_start_offset = places.get(was, was)
        record.chunk_length = sizes.get(was, record.chunk_length)
        record.message_index_offsets = {
            channel: places.get(place, place)
            for channel, place in record.message_index_offsets.items()
        }
        part.record = record
    elif part.opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
        record = part.record
        assert isinstance(record, (records.AttachmentIndex, records.MetadataIndex))
        was = record.offset
        record.offset = places.get(was, was)
        record.length = sizes.get(was, record.length)
        part.record = record
    elif part.opcode == Opcode.SUMMARY_OFFSET:
        record = part.record
        assert isinstance(record, records.SummaryOffset)
        start, size = groups.get(record.group_opcode, [record.group_start, record.group_length])
        part.record = records.SummaryOffset(
            group_opcode=record.group_opcode, group_start=start, group_length=size
        )
    elif part.opcode == Opcode.METADATA:
        record = part.record
        assert isinstance(record, records.Metadata)
        if "checksum" in record.metadata:
            checked = [item for item in record.metadata.items() if item[0] != "checksum"]
            texts = [record.name, *chain.from_iterable(sorted(checked))]
            record.metadata["checksum"] = xxhash.xxh3_64_hexdigest("\0".join(texts).encode())
            part.record = record
    elif part.opcode == Opcode.ATTACHMENT and segments_in(part) is not None:
        rows = [list(row) for row in segments_in(part) or ()]
        for row in rows:
            for place in (7, 9):
                was = row[place]
                row[place] = places.get(was, was)
                row[place + 1] = sizes.get(was, row[place + 1])
        set_segments(part, rows)


def _checksums(parts: list[Part], summary: int, offsets: int) -> None:
    data = b"".join((MAGIC, *(part.bytes for part in parts)))
    at = len(MAGIC)
    for part in parts:
        if part.opcode == Opcode.DATA_END:
            part.body = struct.pack("<I", zlib.crc32(data[:at]))
        elif part.opcode == Opcode.FOOTER:
            empty = at == summary
            start = struct.pack("<QQ", 0 if empty else summary, offsets)
            head = HEAD.pack(Opcode.FOOTER, 20)
            part.body = start + struct.pack("<I", zlib.crc32(data[summary:at] + head + start))
        at += part.size


def segments_in(part: Part) -> list[tuple[int, ...]] | None:
    """Return the rows of ``rsltrace/segments``, None if the part is none."""
    try:
        record = part.record
    except Exception:
        return None
    if not isinstance(record, records.Attachment) or record.name != "rsltrace/segments":
        return None
    if len(record.data) % SEGMENT_ROW.size:
        return None
    return list(SEGMENT_ROW.iter_unpack(record.data))


def set_segments(part: Part, rows: list[list[int]]) -> None:
    """Write the rows of ``rsltrace/segments``."""
    record = part.record
    assert isinstance(record, records.Attachment)
    record.data = b"".join(SEGMENT_ROW.pack(*(v % 2**64 for v in row)) for row in rows)
    part.record = record


def chunk_data(part: Part) -> bytes:
    """Return what is in a chunk, uncompressed."""
    chunk = part.record
    assert isinstance(chunk, records.Chunk)
    if chunk.compression == "zstd":
        return zstandard.ZstdDecompressor().decompress(chunk.data, chunk.uncompressed_size)
    if chunk.compression == "lz4":
        return bytes(lz4.frame.decompress(chunk.data))
    return chunk.data


def set_chunk_data(part: Part, data: bytes, compression: str | None = None) -> None:
    """Put other data into a chunk, with its right size and checksum."""
    chunk = part.record
    assert isinstance(chunk, records.Chunk)
    if compression is not None:
        chunk.compression = compression
    if chunk.compression == "zstd":
        chunk.data = zstandard.ZstdCompressor(level=1).compress(data)
    elif chunk.compression == "lz4":
        chunk.data = lz4.frame.compress(data)
    else:
        chunk.data = data
    chunk.uncompressed_size = len(data)
    chunk.uncompressed_crc = zlib.crc32(data)
    part.record = chunk


def inner(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the records in a chunk: opcode and body."""
    at = 0
    while at < len(data):
        opcode, length = HEAD.unpack_from(data, at)
        yield opcode, data[at + HEAD.size : at + HEAD.size + length]
        at += HEAD.size + length


def joined(inner_records: list[tuple[int, bytes]]) -> bytes:
    """Return a chunk's data from its records."""
    return b"".join(HEAD.pack(opcode, len(body)) + body for opcode, body in inner_records)


def channel_ids(parts: list[Part]) -> dict[str, int]:
    """Return the channels by topic."""
    found = {}
    for part in parts:
        if part.opcode == Opcode.CHANNEL:
            channel = part.record
            assert isinstance(channel, records.Channel)
            found[channel.topic] = channel.id
    return found


def chunks_with(parts: list[Part], channel: int) -> list[Part]:
    """Return the chunks that have messages of a channel."""
    wanted = struct.pack("<H", channel)
    return [
        part
        for part in parts
        if part.opcode == Opcode.CHUNK
        and any(op == Opcode.MESSAGE and body[:2] == wanted for op, body in inner(chunk_data(part)))
    ]


def change_messages(parts: list[Part], topic: str, change: object) -> int:
    """Call ``change(data, nth)`` for the data of each message of a topic; return how many."""
    channel = channel_ids(parts).get(topic)
    if channel is None:
        return 0
    assert callable(change)
    nth = 0
    for part in chunks_with(parts, channel):
        rows = []
        places, was, now = {}, 0, 0
        for opcode, body in inner(chunk_data(part)):
            places[was] = now
            was += HEAD.size + len(body)
            if opcode == Opcode.MESSAGE and body[:2] == struct.pack("<H", channel):
                head, data = body[: MESSAGE_HEAD.size], body[MESSAGE_HEAD.size :]
                body = head + change(data, nth)
                nth += 1
            now += HEAD.size + len(body)
            rows.append((opcode, body))
        set_chunk_data(part, joined(rows))
        _move_messages(parts[parts.index(part) + 1 :], places)
    return nth


def _move_messages(following: list[Part], places: dict[int, int]) -> None:
    """Let the indexes behind a chunk say where its messages are now."""
    for part in takewhile(lambda one: one.opcode == Opcode.MESSAGE_INDEX, following):
        times = struct.iter_unpack("<QQ", part.body[6:])
        moved = (struct.pack("<QQ", time, places.get(at, at)) for time, at in times)
        part.body = part.body[:6] + b"".join(moved)


def rehash(parts: list[Part]) -> str:
    """Make chain and output hashes those of the contents, everywhere; return the digest.

    What somebody does who forges a trace and knows ``docs/trace-format.md``.
    """
    outputs: dict[int, int] = {}

    def fold(data: bytes, nth: int) -> bytes:
        event = int.from_bytes(data[4:12], "little")
        outputs[event] = xxhash.xxh3_64_intdigest(data[12:28], outputs.get(event, 0))
        return data

    change_messages(parts, "/rsltrace/outputs", fold)
    chain: dict[int, int] = {}
    previous = 0

    def link(data: bytes, nth: int) -> bytes:
        nonlocal previous
        event = bytearray(data[4:])
        index = int.from_bytes(event[8:16], "little")
        event[40:48] = struct.pack("<Q", outputs.get(index, 0))
        previous = xxhash.xxh3_64_intdigest(bytes(event[8:70]), previous)
        event[0:8] = struct.pack("<Q", previous)
        chain[index] = previous
        return data[:4] + bytes(event)

    change_messages(parts, "/rsltrace/events", link)
    digest = f"{previous:016x}"
    for part in parts:
        if part.opcode == Opcode.METADATA:
            record = part.record
            assert isinstance(record, records.Metadata)
            if record.name == "rsltrace:result" and "digest" in record.metadata:
                record.metadata["digest"] = digest
                part.record = record
        rows = segments_in(part) if part.opcode == Opcode.ATTACHMENT else None
        if rows:
            changed = [list(row) for row in rows]
            for row in changed:
                row[4] = chain.get(row[0] + row[1] - 1, row[4])
            set_segments(part, changed)
    return digest
