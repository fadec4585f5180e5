"""Pieces of a trace file, each read with an error that says where it is damaged and what to do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain

import xxhash
from mcap.opcode import Opcode

from rsltrace.errors import TraceError
from rsltrace.trace.format import CHECKSUM_KEY
from rsltrace.trace.mcap import chunk as mcap_chunk
from rsltrace.trace.mcap import walk
from rsltrace.trace.mcap.checksum import crc32
from rsltrace.trace.mcap.limits import CHUNK_BYTES_MAX
from rsltrace.trace.mcap.records import (
    MESSAGE,
    MESSAGE_HEAD,
    RECORD_HEAD,
    Damaged,
    Fields,
    Span,
    records_in,
)
from rsltrace.trace.mcap.source import ByteSource

_CRC_BYTES = 4
_MESSAGE_BODY_MIN = MESSAGE_HEAD.size - RECORD_HEAD.size
_RECORDS_PER_CHUNK_MAX = 1 << 17
"""A chunk of payloads is closed once it holds half a megabyte, which has room for fewer."""


def damaged(source: ByteSource, offset: int, what: str, why: object) -> TraceError:
    """Return the error for damage found at ``offset`` of the file."""
    return TraceError(
        f"{source.name}: {what} at offset {offset} is damaged ({why}); "
        "copy the file again or record it again"
    )


def read_body(source: ByteSource, span: Span, opcode: int, what: str) -> bytes:
    """Return the body of the record at ``span``. Raises TraceError if it is not such a record."""
    try:
        return walk.read_body(source, span, opcode)
    except Damaged as error:
        raise damaged(source, span.offset, what, error) from error


def read_chunk(source: ByteSource, span: Span, size_max: int = CHUNK_BYTES_MAX) -> bytes:
    """Return the records of the chunk at ``span``, their CRC checked. Raises TraceError."""
    try:
        return mcap_chunk.read_chunk(source, span, size_max)
    except Damaged as error:
        raise damaged(source, span.offset, "the chunk", error) from error


def read_attachment(source: ByteSource, span: Span) -> bytes:
    """Return the data of the attachment at ``span``, its CRC checked. Raises TraceError."""
    body = read_body(source, span, Opcode.ATTACHMENT, "the attachment")
    content, crc = body[:-_CRC_BYTES], body[-_CRC_BYTES:]
    try:
        if crc32(content) != int.from_bytes(crc, "little"):
            raise Damaged("its checksum does not match")
        fields = Fields(content)
        fields.take(16)  # times
        fields.text()
        fields.text()
        return fields.take(fields.u64())
    except Damaged as error:
        raise damaged(source, span.offset, "the attachment", error) from error


def metadata_checksum(name: str, mapping: Mapping[str, str]) -> str:
    """Return the checksum of a metadata record: XXH3 of its name, keys and values, in hex.

    A zero byte stands between them, and the keys are in their order.
    """
    texts = [name, *chain.from_iterable(sorted(mapping.items()))]
    return xxhash.xxh3_64_hexdigest("\0".join(texts).encode())


def read_metadata(source: ByteSource, span: Span, *, checked: bool = False) -> dict[str, str]:
    """Return the mapping of the metadata record at ``span``, without the checksum it may have.

    ``checked``: it must have one. Raises TraceError.
    """
    fields = Fields(read_body(source, span, Opcode.METADATA, "the metadata"))
    try:
        name, mapping = fields.text(), fields.mapping()
        said = mapping.pop(CHECKSUM_KEY, None)
        if (checked or said is not None) and said != metadata_checksum(name, mapping):
            raise Damaged(f"the checksum of {name!r} does not match")
        return mapping
    except Damaged as error:
        raise damaged(source, span.offset, "the metadata", error) from error


def messages_in(records: bytes) -> Iterator[tuple[int, int]]:
    """Yield (channel, offset) of the messages of a chunk, in order. Raises Damaged."""
    for number, (opcode, start, end) in enumerate(records_in(records)):
        if number >= _RECORDS_PER_CHUNK_MAX:
            raise Damaged("it holds more records than a chunk of a trace")
        if opcode == MESSAGE:
            if end - start < _MESSAGE_BODY_MIN:
                raise Damaged(f"a message at {start} of the chunk is too short")
            channel_id = int.from_bytes(records[start : start + 2], "little")
            yield channel_id, start - RECORD_HEAD.size
