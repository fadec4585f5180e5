"""Write an MCAP file record by record, with its summary at the end.

This layer knows MCAP and the disk but not what a trace is: see ``rsltrace.trace.writer``.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import zstandard
from mcap.opcode import Opcode

from rsltrace.errors import OutputError
from rsltrace.trace.mcap.chunk_builder import ChunkBody
from rsltrace.trace.mcap.records import (
    MAGIC,
    MESSAGE_ENCODING,
    RECORD_HEAD,
    SCHEMA_ENCODING,
    McapChannel,
    McapSchema,
    crc32,
    crc_of,
    joined_crc,
)
from rsltrace.trace.mcap.sink import Sink

_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_NUMBERED = struct.Struct("<HQ")
_IDS = struct.Struct("<HH")
_CHUNK_HEAD = struct.Struct("<QQQI")
_CHUNK_INDEX_HEAD = struct.Struct("<QQQQ")
_CHUNK_SIZES = struct.Struct("<QQ")
_ATTACHMENT_TIMES = struct.Struct("<QQ")
_ATTACHMENT_INDEX_HEAD = struct.Struct("<QQQQQ")
_STATISTICS_HEAD = struct.Struct("<QHIIIIQQ")
_SUMMARY_OFFSET = struct.Struct("<BQQ")
_FOOTER = struct.Struct("<QQ")
_FOOTER_BYTES = 20


def _record(opcode: Opcode, *fields: bytes) -> bytes:
    """Return a record as in the file. The ``mcap`` package has classes of them, which take as long
    to import as a short run takes to write."""
    body = b"".join(fields)
    return RECORD_HEAD.pack(opcode, len(body)) + body


def _bytes(data: bytes) -> bytes:
    return _U32.pack(len(data)) + data


def _text(text: str) -> bytes:
    return _bytes(text.encode())


def _texts(mapping: Mapping[str, str]) -> bytes:
    return _bytes(b"".join(_text(key) + _text(value) for key, value in mapping.items()))


def _numbers(mapping: Mapping[int, int]) -> bytes:
    return _bytes(b"".join(_NUMBERED.pack(key, value) for key, value in mapping.items()))


def _schema(schema: McapSchema) -> bytes:
    fields = schema.name, schema.encoding, schema.text
    return _record(Opcode.SCHEMA, schema.id.to_bytes(2, "little"), *map(_text, fields))


def _channel(channel: McapChannel) -> bytes:
    return _record(
        Opcode.CHANNEL,
        _IDS.pack(channel.id, channel.schema_id),
        _text(channel.topic),
        _text(channel.message_encoding),
        _texts(channel.metadata),
    )


# The end of an MCAP file, where readers look first. The writer reports each record, and the summary
# keeps what it needs in its final form.


class SummaryBuilder:
    """Collects the summary section. Memory: about 100 bytes per chunk."""

    def __init__(self) -> None:
        self.schemas: list[McapSchema] = []
        self.channels: list[McapChannel] = []
        self.message_counts: dict[int, int] = {}
        self.start_ns = 0
        self.end_ns = 0
        self._chunk_count = 0
        self._chunk_indexes = bytearray()
        self._attachment_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []

    @property
    def message_count(self) -> int:
        """The number of messages in all chunks so far."""
        return sum(self.message_counts.values())

    def add_chunk(
        self, body: ChunkBody, *, offset: int, length: int, compression: str, compressed_size: int
    ) -> None:
        """Add a chunk at ``offset`` with ``length`` bytes, directly followed by its indexes."""
        if not self._chunk_count:
            self.start_ns, self.end_ns = body.start_ns, body.end_ns
        self.start_ns = min(self.start_ns, body.start_ns)
        self.end_ns = max(self.end_ns, body.end_ns)
        self._chunk_count += 1
        index_offsets = {}
        position = offset + length
        for channel_id, count, record in body.indexes:
            index_offsets[channel_id] = position
            position += len(record)
            self.message_counts[channel_id] = self.message_counts.get(channel_id, 0) + count
        # Kept as bytes: a long run has a million chunks, and objects would be ten times as large.
        self._chunk_indexes += _record(
            Opcode.CHUNK_INDEX,
            _CHUNK_INDEX_HEAD.pack(body.start_ns, body.end_ns, offset, length),
            _numbers(index_offsets),
            _U64.pack(position - offset - length),
            _text(compression),
            _CHUNK_SIZES.pack(compressed_size, body.size),
        )

    def add_attachment(
        self, name: str, media_type: str, *, size: int, offset: int, length: int
    ) -> None:
        """Add an attachment of ``size`` bytes whose record is at ``offset``."""
        head = _ATTACHMENT_INDEX_HEAD.pack(offset, length, 0, 0, size)
        self._attachment_indexes.append(
            _record(Opcode.ATTACHMENT_INDEX, head, _text(name), _text(media_type))
        )

    def add_metadata(self, name: str, *, offset: int, length: int) -> None:
        """Add a metadata record at ``offset``."""
        self._metadata_indexes.append(
            _record(Opcode.METADATA_INDEX, _U64.pack(offset), _U64.pack(length), _text(name))
        )

    def tail(self, summary_start: int) -> bytes:
        """Return summary section and footer of a file whose data section ends here."""
        head = _STATISTICS_HEAD.pack(
            self.message_count,
            len(self.schemas),
            len(self.channels),
            len(self._attachment_indexes),
            len(self._metadata_indexes),
            self._chunk_count,
            self.start_ns,
            self.end_ns,
        )
        counts = _numbers(dict(sorted(self.message_counts.items())))
        groups = (
            (Opcode.SCHEMA, b"".join(map(_schema, self.schemas))),
            (Opcode.CHANNEL, b"".join(map(_channel, self.channels))),
            (Opcode.STATISTICS, _record(Opcode.STATISTICS, head, counts)),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, b"".join(self._attachment_indexes)),
            (Opcode.METADATA_INDEX, b"".join(self._metadata_indexes)),
        )
        summary = bytearray()
        offsets = bytearray()
        for opcode, group in groups:
            if group:
                start = summary_start + len(summary)
                place = _SUMMARY_OFFSET.pack(opcode, start, len(group))
                offsets += _record(Opcode.SUMMARY_OFFSET, place)
                summary += group
        offsets_start = summary_start + len(summary)
        summary += offsets
        summary += RECORD_HEAD.pack(Opcode.FOOTER, _FOOTER_BYTES)
        summary += _FOOTER.pack(summary_start, offsets_start)
        return bytes(summary) + _U32.pack(zlib.crc32(summary))


CHANNELS_MAX = 2**16 - 1
_ZSTD_LEVEL = 1
"""Level 3 saves little space for ten times the time."""

_SAMPLES = 32
_SAMPLE_BYTES = 16 << 10
_PAYS = 0.8
"""Large messages are compressed only if samples, an eighth at most, shrink to this factor."""

_TRUSTED = 15
"""The number of chunks with large messages of a topic that go without a test after one."""

_ROWS = zstandard.ZstdCompressionParameters.from_level(
    _ZSTD_LEVEL, window_log=19, hash_log=10, min_match=7, target_length=1
)
"""For rows of one size, which resemble those just before: a small table, which stays in the nearest
cache, takes four fifths of the time and no more space."""


class McapWriter:
    """Writes records in order. Every method raises OutputError when the disk refuses.

    ``progress`` describes what was written so far, for that error.
    """

    def __init__(
        self,
        path: Path,
        *,
        force: bool,
        compression: str,
        profile: str,
        library: str,
        progress: Callable[[], str],
    ) -> None:
        self._prepare(compression, progress)
        self._sink = Sink(path, force=force)
        try:
            self._write(MAGIC + _record(Opcode.HEADER, _text(profile), _text(library)))
        except OutputError:
            self.abort()
            raise

    def _prepare(self, compression: str, progress: Callable[[], str]) -> None:
        if compression not in ("zstd", ""):
            raise ValueError(f"compression is 'zstd' or '', not {compression!r}")
        self._compression = compression
        self._compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL)
        self._row_compressor = zstandard.ZstdCompressor(compression_params=_ROWS)
        self._trusted: dict[tuple[int, ...], tuple[int, bool]] = {}
        self._progress = progress
        self._summary = SummaryBuilder()
        self._schema_ids: dict[tuple[str, str], int] = {}
        self._failure: OutputError | None = None

    def copy_compressibility(self, other: McapWriter) -> None:
        """Take over what another writer, whose chunks come first, knows of large messages."""
        self._trusted = dict(other._trusted)

    @property
    def place(self) -> Path:
        """The written file: beside the one that it replaces, until it is finished."""
        return self._sink.place

    @property
    def kept(self) -> str:
        """What to say about a file that should have been replaced and was not; else ""."""
        return self._sink.kept

    @property
    def bytes_written(self) -> int:
        """Size of the file so far."""
        return self._sink.offset

    @property
    def closed(self) -> bool:
        """Whether the file was finished or aborted."""
        return self._sink.closed

    @property
    def start_ns(self) -> int:
        """Smallest log time of all messages so far (0: none)."""
        return self._summary.start_ns

    @property
    def end_ns(self) -> int:
        """Largest log time of all messages so far (0: none)."""
        return self._summary.end_ns

    @property
    def channels(self) -> list[tuple[McapChannel, str, int]]:
        """Each channel with the name of its type and its number of messages."""
        counts = self._summary.message_counts
        names = {schema.id: schema.name for schema in self._summary.schemas}
        return [(c, names[c.schema_id], counts.get(c.id, 0)) for c in self._summary.channels]

    def channel(
        self, topic: str, type_name: str, schema_text: str, metadata: Mapping[str, str]
    ) -> int:
        """Write a channel, and its schema unless an equal one is there. Returns its id."""
        channel_id = len(self._summary.channels) + 1
        if channel_id > CHANNELS_MAX:
            raise OutputError(
                f"{self._sink.path}: {topic} is one topic too many: a trace can hold "
                f"{CHANNELS_MAX}; leave topics out (record: in the job)"
            )
        schema_id = self._schema_ids.get((type_name, schema_text))
        if schema_id is None:
            schema_id = len(self._schema_ids) + 1
            schema = McapSchema(schema_id, type_name, SCHEMA_ENCODING, schema_text)
            self._write(_schema(schema))
            self._schema_ids[type_name, schema_text] = schema_id
            self._summary.schemas.append(schema)
        channel = McapChannel(channel_id, schema_id, topic, MESSAGE_ENCODING, dict(metadata))
        self._write(_channel(channel))
        self._summary.channels.append(channel)
        return channel_id

    def metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        """Write a metadata record."""
        record = _record(Opcode.METADATA, _text(name), _texts(mapping))
        self._summary.add_metadata(name, offset=self._sink.offset, length=len(record))
        self._write(record)

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment. Its times are 0: dates would make files of equal runs differ."""
        head = _ATTACHMENT_TIMES.pack(0, 0), _text(name), _text(media_type)
        body = b"".join((*head, _U64.pack(len(data)), data))
        record = _record(Opcode.ATTACHMENT, body, _U32.pack(zlib.crc32(body)))
        offset = self._sink.offset
        self._summary.add_attachment(
            name, media_type, size=len(data), offset=offset, length=len(record)
        )
        self._write(record)

    def chunk(self, body: ChunkBody) -> tuple[int, int]:
        """Write a chunk and its message indexes. Returns the Chunk record's (offset, length)."""
        return self.packed_chunk(body, *self.packed(body))

    def packed_chunk(
        self, body: ChunkBody, compression: str, data: tuple[bytes, ...], crc: int
    ) -> tuple[int, int]:
        """Write a chunk whose data was made by ``packed``."""
        size = sum(map(len, data))
        # The data is not copied behind its head.
        head = _CHUNK_HEAD.pack(body.start_ns, body.end_ns, body.size, crc) + _text(compression)
        head += _U64.pack(size)
        head = RECORD_HEAD.pack(Opcode.CHUNK, len(head) + size) + head
        offset, length = self._sink.offset, len(head) + size
        indexes = b"".join(index for _, _, index in body.indexes)
        whole: int | None = None
        if not compression:  # the data have been summed already
            whole = joined_crc(crc32(head, self._sink.crc), crc, size)
            whole = crc32(indexes, whole)
        self._write(head, *data, indexes, crc=whole)
        self._summary.add_chunk(
            body,
            offset=offset,
            length=length,
            compression=compression,
            compressed_size=size,
        )
        return offset, length

    def packed(self, body: ChunkBody) -> tuple[str, tuple[bytes, ...], int]:
        """Return a chunk's compression, its data in parts, and the CRC-32 before compression."""
        return *self._packed(body), crc_of(body.parts)

    def _packed(self, body: ChunkBody) -> tuple[str, tuple[bytes, ...]]:
        """Return the compression of a chunk, and its data in parts.

        Compressing what does not shrink takes up to seven times as long as writing it (numbers of a
        point cloud), so samples of large messages decide, for the topic's next ones, too. Only the
        bytes matter, so equal runs give equal files.
        """
        if not self._compression:
            return "", body.parts
        if len(body.parts) > 1:
            channels = tuple(channel for channel, _, _ in body.indexes)
            trusted, pays = self._trusted.get(channels, (0, False))
            if not trusted:
                trusted, pays = _TRUSTED + 1, self._pays(body.parts)
            self._trusted[channels] = trusted - 1, pays
            if not pays:
                return "", body.parts
        packer = self._row_compressor if body.rows else self._compressor
        return self._compression, (packer.compress(body.records),)

    def _pays(self, parts: tuple[bytes, ...]) -> bool:
        total = packed = 0
        for part in parts:
            step = max(len(part) // _SAMPLES, 8 * _SAMPLE_BYTES)
            for at in range(0, len(part), step):
                sample = part[at : at + _SAMPLE_BYTES]
                total += len(sample)
                packed += len(self._compressor.compress(sample))
        return packed < _PAYS * total

    def finish(self, *, replace: bool = True) -> None:
        """Write the end of the file, check the file, and close it.

        With ``replace``, it replaces the file that was there.
        """
        self._write(_record(Opcode.DATA_END, _U32.pack(self._sink.crc)))
        self._write(self._summary.tail(self._sink.offset) + MAGIC)
        try:
            self._sink.finish(replace=replace)
        except OSError as error:
            raise self._failed(error) from error

    def abort(self) -> None:
        """Close the file as it is. What was written stays readable."""
        try:
            self._sink.close()
        except OSError:
            pass  # there is nothing left to save, and the error that led here is the one to show

    def poison(self) -> None:
        """Refuse all further records, because one may be incomplete.

        KeyboardInterrupt can occur between any two steps of a write. Appending a whole record to
        half a one would be worse than an interrupted file.
        """
        if self._failure is None:
            self._failure = OutputError(
                f"writing the trace {self._sink.place} was interrupted in the middle of a segment; "
                "what was written before is readable up to its last whole segment"
            )

    def _write(self, *parts: bytes, crc: int | None = None) -> None:
        if self._failure is not None:
            raise self._failure  # after a gap in the file, nothing more may follow
        try:
            self._sink.write(*parts, crc=crc)
        except OSError as error:
            raise self._failed(error) from error
        except OutputError as error:
            self._failure = error
            raise
        except BaseException:
            self.poison()
            raise

    def _failed(self, error: OSError) -> OutputError:
        code = errno.errorcode.get(error.errno or 0, "unknown")
        reason = os.strerror(error.errno) if error.errno else str(error)
        hint = _HINTS.get(error.errno or 0, "check the disk, or choose another place with -o")
        kept = self.kept and f"; {self.kept}"
        self._failure = OutputError(
            f"cannot go on writing the trace {self.place}: {reason} ({code}) after "
            f"{self._sink.offset} bytes, {self._progress()}; what was written is readable up to "
            f"its last whole segment{kept}; {hint}"
        )
        return self._failure


_HINTS = {
    errno.ENOSPC: "free some space or choose another disk with -o",
    errno.EDQUOT: "your disk quota is used up: free some space or choose another disk with -o",
    errno.EFBIG: "the file reached its size limit (ulimit -f, or the file system's)",
}


# Many runs may share one beginning. It is recorded once, and each run's file begins with it.


class BufferedWriter(McapWriter):
    """Buffers calls of ``McapWriter`` until ``write_to``. Metadata and attachments of the same name
    replace each other."""

    def __init__(self, *, compression: str, profile: str, library: str) -> None:
        self._prepare(compression, progress=lambda: "nothing is on the disk")
        self._about = {"profile": profile, "library": library}
        self._records: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        self._channels = 0
        self._chunks = 0

    @property
    def bytes_written(self) -> int:
        """0: there is no file."""
        return 0

    def channel(
        self, topic: str, type_name: str, schema_text: str, metadata: Mapping[str, str]
    ) -> int:
        """Buffer a channel; return its future id."""
        self._add(McapWriter.channel, topic, type_name, schema_text, metadata)
        self._channels += 1
        return self._channels

    def metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        self._add(McapWriter.metadata, name, mapping)

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        self._add(McapWriter.attachment, name, media_type, data)

    def chunk(self, body: ChunkBody) -> tuple[int, int]:
        """Buffer a chunk; return its number, and 0: its offset is known after ``write_to``."""
        self._add(McapWriter.packed_chunk, body, *self.packed(body))
        self._chunks += 1
        return self._chunks - 1, 0

    def _add(self, write: Callable[..., Any], *what: Any) -> None:
        if write in (McapWriter.metadata, McapWriter.attachment):
            for index, (other, there) in enumerate(self._records):
                if other is write and there[0] == what[0]:
                    self._records[index] = (write, what)
                    return
        self._records.append((write, what))

    def write_to(
        self, path: Path, *, force: bool, progress: Callable[[], str]
    ) -> tuple[McapWriter, list[tuple[int, int]]]:
        """Create the file; return its writer, and where each chunk is.

        :raises OutputError: the disk refuses, or something else has that name.
        """
        writer = McapWriter(
            path, force=force, compression=self._compression, progress=progress, **self._about
        )
        try:
            found = [(write, write(writer, *what)) for write, what in self._records]
        except BaseException:
            writer.abort()
            raise
        writer.copy_compressibility(self)
        return writer, [where for write, where in found if write is McapWriter.packed_chunk]

    def abort(self) -> None:
        """Do nothing: there is no file."""

    def poison(self) -> None:
        """Do nothing: no record can be half written."""
