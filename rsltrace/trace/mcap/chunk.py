"""Read chunks of MCAP messages: decompressed within limits and checked."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from operator import itemgetter
from typing import NamedTuple

from mcap.opcode import Opcode

from rsltrace.trace.mcap.records import (
    CHUNK_BYTES_MAX,
    MESSAGE,
    MESSAGE_HEAD,
    RECORD_HEAD,
    DamageError,
    RecordSpan,
    crc32,
    records_in,
)
from rsltrace.trace.mcap.source import ByteSource

PUBLISH_TIME_BYTES = 8

_CHUNK_HEAD = struct.Struct("<BQQQQII")
"""Opcode, length, first and last log time, size and CRC unpacked, length of the compression."""

_APART_BYTES_MIN = 64 << 10
_HEAD_BYTES_MAX = 512
"""What is read of a chunk for its fields before the data: longer ones name no known compression."""

_U64 = struct.Struct("<Q")
_HEAD_BYTES = RECORD_HEAD.size
_MESSAGE_BYTES_MIN = MESSAGE_HEAD.size


class ChunkMessage(NamedTuple):
    """A message in a chunk: header fields, and the position of its data in the records."""

    channel_id: int
    sequence: int
    log_time: int
    start: int
    end: int


def read_chunk(
    source: ByteSource, span: RecordSpan, size_max: int = CHUNK_BYTES_MAX, *, strict: bool = True
) -> bytes:
    """Return the records of the chunk at ``span``. Raises DamageError.

    Chunks larger than ``size_max`` are refused before decompression. MCAP allows a CRC of 0 (none)
    and extra fields at the end of a record; ``strict`` does not.
    """
    if span.length < _CHUNK_HEAD.size:
        raise DamageError(f"its length is given as {span.length}")
    # Much data of a file is read apart: it need not be copied out of its record.
    apart = span.length >= _APART_BYTES_MIN and not source.is_remote
    first = _HEAD_BYTES_MAX if apart else span.length
    record = source.read_at(span.offset, first)
    opcode, length, _, _, size, crc, text = _CHUNK_HEAD.unpack_from(record)
    if opcode != Opcode.CHUNK or length + _HEAD_BYTES != span.length:
        raise DamageError("there is no chunk where the index says")
    data_at = _CHUNK_HEAD.size + text + _U64.size
    data_end = data_at
    if data_at <= len(record):
        data_end += _U64.unpack_from(record, data_at - _U64.size)[0]
    if data_end > span.length or (strict and data_end != span.length):
        raise DamageError("the chunk's bytes do not end where its record does")
    if size > size_max:
        raise DamageError(f"a chunk of {size} bytes, where at most {size_max} can be")
    if data_end <= len(record):
        data = record[data_at:data_end]
    else:
        data = source.read_at(span.offset + data_at, data_end - data_at)
    records = _unpacked(data, record[_CHUNK_HEAD.size : data_at - _U64.size], size)
    if len(records) != size:
        raise DamageError(f"the chunk holds {len(records)} bytes where {size} are promised")
    if (crc or strict) and crc32(records) != crc:
        raise DamageError("the chunk's CRC does not match its content")
    return records


def _unpacked(data: bytes, compression: bytes, size: int) -> bytes:
    if compression == b"":
        return data
    if compression == b"zstd":
        return _unzstd(data, size)
    if compression == b"lz4":
        return _unlz4(data, size)
    name = compression.decode("utf-8", "replace")
    raise DamageError(f"the compression {name!r} is unknown (not zstd or lz4)")


def _unzstd(data: bytes, size: int) -> bytes:
    import zstandard

    try:
        # The frame may claim any size, so check it before allocating memory.
        claimed = zstandard.frame_content_size(data)
        if claimed > size:
            raise DamageError(f"the chunk holds {claimed} bytes where {size} are promised")
        if size == 0:
            return b""
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    except (zstandard.ZstdError, MemoryError) as error:
        raise DamageError(f"the chunk cannot be decompressed ({error})") from None


def _unlz4(data: bytes, size: int) -> bytes:
    import lz4.frame  # type: ignore[import-untyped]

    try:
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except (RuntimeError, EOFError, MemoryError) as error:
        raise DamageError(f"the chunk cannot be decompressed ({error})") from None


def message_at(records: bytes, offset: int, of_channel: int) -> ChunkMessage:
    """Return the message record at ``offset`` of a chunk. Raises DamageError if there is
    none of that channel."""
    if offset + _MESSAGE_BYTES_MIN > len(records):
        raise DamageError(f"no message fits at {offset} of the chunk")
    opcode, length, channel_id, sequence, log_time, _ = MESSAGE_HEAD.unpack_from(records, offset)
    end = offset + _HEAD_BYTES + length
    if opcode != MESSAGE or length < _MESSAGE_BYTES_MIN - _HEAD_BYTES or end > len(records):
        raise DamageError(f"there is no whole message at {offset} of the chunk")
    if channel_id != of_channel:
        raise DamageError(f"the message at {offset} is of another channel than the index says")
    return ChunkMessage(channel_id, sequence, log_time, offset + _MESSAGE_BYTES_MIN, end)


def cut_messages(
    records: bytes, wanted: Mapping[int, int], first_ns: int, *, with_publish_time: bool = False
) -> list[tuple[int, int, bytes]]:
    """Return (log time, number, data) of the wanted messages of a chunk, by time and then position.

    ``wanted`` maps channel ids to numbers. ``with_publish_time`` puts it before the data (8 bytes,
    little-endian). Raises DamageError when a record is cut off.
    """
    # The publish time is the last field before the data.
    data_at = _MESSAGE_BYTES_MIN - (PUBLISH_TIME_BYTES if with_publish_time else 0)
    messages: list[tuple[int, int, bytes]] = []
    unpack, number_of, shortest = MESSAGE_HEAD.unpack_from, wanted.get, _MESSAGE_BYTES_MIN
    at, end, previous_ns, ordered = 0, len(records), first_ns, True
    while at + shortest <= end:
        opcode, length, channel, _, stamp_ns, _ = unpack(records, at)
        following = at + _HEAD_BYTES + length
        if opcode != MESSAGE:
            at = following
            continue
        if following > end or following - at < shortest:
            raise DamageError("a message runs past the end of its chunk")
        number = number_of(channel)
        if number is not None and stamp_ns >= first_ns:
            messages.append((stamp_ns, number, records[at + data_at : following]))
            if stamp_ns < previous_ns:
                ordered = False
            previous_ns = stamp_ns
        at = following
    # The rest can only be other records, shorter than any message.
    if at > end or any(opcode == MESSAGE for opcode, _, _ in records_in(records[at:])):
        raise DamageError("a record runs past the end of its chunk")
    if not ordered:
        messages.sort(key=itemgetter(0))
    return messages
