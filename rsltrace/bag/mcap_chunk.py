"""The inside of a chunk: decompressed, checked, and cut into messages."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from operator import itemgetter
from typing import BinaryIO

from rsltrace.bag.mcap_records import (
    CHUNK,
    MESSAGE,
    MESSAGE_HEAD,
    RECORD_HEAD,
    ChunkHead,
    parse_chunk_head,
)
from rsltrace.bag.merge import Message

CHUNK_BYTES_MAX = 1 << 30
"""No writer makes chunks of this size; a larger number is a damaged or hostile one."""

PUBLISH_TIME_BYTES = 8

_HEAD_BYTES = RECORD_HEAD.size
_DATA_AT = 1 + MESSAGE_HEAD.size


def read_chunk(file: BinaryIO, offset: int, length: int) -> bytes:
    """Return the decompressed records of the chunk record at ``offset``. Raises ``ValueError``."""
    file.seek(offset)
    record = file.read(length)
    if len(record) != length or length < _HEAD_BYTES:
        raise ValueError("the chunk is cut off")
    opcode, content_length = RECORD_HEAD.unpack_from(record)
    if opcode != CHUNK or content_length != length - _HEAD_BYTES:
        raise ValueError("there is no chunk where the index says")
    content = record[_HEAD_BYTES:]
    return decompress_chunk(parse_chunk_head(content), content)


def decompress_chunk(head: ChunkHead, record: bytes) -> bytes:
    """Return a chunk's records. Raises ``ValueError`` when size or CRC are not what it says."""
    if head.size > CHUNK_BYTES_MAX:
        raise ValueError(f"a chunk of {head.size} bytes")
    raw = record[head.data]
    if head.compression == "":
        data = raw
    elif head.compression == "zstd":
        data = _unzstd(raw, head.size)
    elif head.compression == "lz4":
        data = _unlz4(raw, head.size)
    else:
        raise ValueError(f"the compression {head.compression!r} is unknown (not zstd or lz4)")
    if len(data) != head.size:
        raise ValueError(f"the chunk holds {len(data)} bytes where {head.size} are promised")
    if head.crc and zlib.crc32(data) != head.crc:
        raise ValueError("the chunk's CRC does not match its content")
    return data


def _unzstd(raw: bytes, size: int) -> bytes:
    import zstandard

    try:
        # The frame may claim any size; it must not be believed before memory is taken.
        claimed = zstandard.frame_content_size(raw)
        if claimed > size:
            raise ValueError(f"the chunk holds {claimed} bytes where {size} are promised")
        if size == 0:
            return b""
        return zstandard.ZstdDecompressor().decompress(raw, max_output_size=size)
    except zstandard.ZstdError as error:
        raise ValueError(f"the chunk cannot be decompressed ({error})") from None


def _unlz4(raw: bytes, size: int) -> bytes:
    import lz4.frame  # type: ignore[import-untyped]

    try:
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(raw, max_length=size + 1))
    except (RuntimeError, EOFError) as error:
        raise ValueError(f"the chunk cannot be decompressed ({error})") from None


def cut_messages(
    data: bytes, wanted: Mapping[int, int], first_ns: int, *, with_publish_time: bool = False
) -> list[Message]:
    """Return the wanted messages among records, by time, equal times as they stand.

    ``wanted`` maps channel ids to topic indices; ``with_publish_time`` puts it in front of the
    bytes, 8 of them, little-endian. Raises ``ValueError`` when a record is cut off.
    """
    # The publish time is the last field before the data.
    data_at = _DATA_AT - PUBLISH_TIME_BYTES if with_publish_time else _DATA_AT
    messages: list[Message] = []
    unpack, topic_of = MESSAGE_HEAD.unpack_from, wanted.get
    at, end, previous_ns, ordered = 0, len(data), first_ns, True
    while at + _DATA_AT <= end:
        if data[at] != MESSAGE:
            at += _HEAD_BYTES + int.from_bytes(data[at + 1 : at + _HEAD_BYTES], "little")
            continue
        length, channel, _, stamp_ns, _ = unpack(data, at + 1)
        following = at + _HEAD_BYTES + length
        if following > end or length < _DATA_AT - _HEAD_BYTES:
            raise ValueError("a message runs past the end of its chunk")
        topic = topic_of(channel)
        if topic is not None and stamp_ns >= first_ns:
            messages.append((stamp_ns, topic, data[at + data_at : following]))
            if stamp_ns < previous_ns:
                ordered = False
            previous_ns = stamp_ns
        at = following
    # What is left can only be records of other kinds, shorter than any message.
    if at > end or any(opcode == MESSAGE for opcode, _, _ in iterate_records(data[at:])):
        raise ValueError("a record runs past the end of its chunk")
    if not ordered:
        messages.sort(key=itemgetter(0))
    return messages


def iterate_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end) of the contents of the records in ``data``."""
    at = 0
    while at < len(data):
        if at + _HEAD_BYTES > len(data):
            raise ValueError("a record runs past the end of its chunk")
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        start, at = at + _HEAD_BYTES, at + _HEAD_BYTES + length
        if at > len(data):
            raise ValueError("a record runs past the end of its chunk")
        yield opcode, start, at
