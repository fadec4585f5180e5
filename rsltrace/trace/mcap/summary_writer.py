"""The end of an MCAP file: what a reader looks at first to find everything else.

The writer reports each record it puts into the data section; this module keeps just enough of it,
already in the form it will have in the file, to write the summary when the trace is closed.
"""

from __future__ import annotations

import struct
import zlib

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from rsltrace.trace.mcap.chunk_body import ChunkBody

_FOOTER_BEFORE_CRC = struct.Struct("<BQQQ")
_FOOTER_BYTES = 20


def record_bytes(record: McapRecord) -> bytes:
    """Return ``record`` as it stands in the file, opcode and length included."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # mcap leaves it bare


class SummaryBuilder:
    """Collects what the summary section will say. Memory: about 100 bytes per chunk."""

    def __init__(self) -> None:
        self.schemas: list[Schema] = []
        self.channels: list[Channel] = []
        self.message_counts: dict[int, int] = {}
        self.start_ns = 0
        self.end_ns = 0
        self._chunk_count = 0
        self._chunk_indexes = bytearray()
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []

    @property
    def message_count(self) -> int:
        """How many messages all chunks so far hold."""
        return sum(self.message_counts.values())

    def add_chunk(
        self, body: ChunkBody, *, offset: int, length: int, compression: str, compressed_size: int
    ) -> None:
        """Note a chunk written at ``offset`` with ``length`` bytes, its indexes right behind it."""
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
        index = ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression=compression,
            compressed_size=compressed_size,
            message_end_time=body.end_ns,
            message_index_length=position - offset - length,
            message_index_offsets=index_offsets,
            message_start_time=body.start_ns,
            uncompressed_size=body.size,
        )
        # Kept as bytes: a long run has a million chunks, and objects would be ten times as large.
        self._chunk_indexes += record_bytes(index)

    def add_attachment(
        self, name: str, media_type: str, *, size: int, offset: int, length: int
    ) -> None:
        """Note an attachment of ``size`` bytes whose record is at ``offset``."""
        self._attachment_indexes.append(
            AttachmentIndex(
                offset=offset,
                length=length,
                log_time=0,
                create_time=0,
                data_size=size,
                name=name,
                media_type=media_type,
            )
        )

    def add_metadata(self, name: str, *, offset: int, length: int) -> None:
        """Note a metadata record at ``offset``."""
        self._metadata_indexes.append(MetadataIndex(offset=offset, length=length, name=name))

    def tail(self, summary_start: int) -> bytes:
        """Return summary section and footer for a file whose data section ends before this."""
        statistics = Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self.channels),
            channel_message_counts=dict(sorted(self.message_counts.items())),
            chunk_count=self._chunk_count,
            message_count=self.message_count,
            message_end_time=self.end_ns,
            message_start_time=self.start_ns,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self.schemas),
        )
        groups = (
            (Opcode.SCHEMA, b"".join(map(record_bytes, self.schemas))),
            (Opcode.CHANNEL, b"".join(map(record_bytes, self.channels))),
            (Opcode.STATISTICS, record_bytes(statistics)),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, b"".join(map(record_bytes, self._attachment_indexes))),
            (Opcode.METADATA_INDEX, b"".join(map(record_bytes, self._metadata_indexes))),
        )
        summary = bytearray()
        offsets = bytearray()
        for opcode, group in groups:
            if group:
                start = summary_start + len(summary)
                offsets += record_bytes(SummaryOffset(opcode, start, len(group)))
                summary += group
        offsets_start = summary_start + len(summary)
        summary += offsets
        covered = _FOOTER_BEFORE_CRC.pack(
            Opcode.FOOTER, _FOOTER_BYTES, summary_start, offsets_start
        )
        crc = zlib.crc32(covered, zlib.crc32(summary))
        return bytes(summary) + record_bytes(Footer(summary_start, offsets_start, crc))
