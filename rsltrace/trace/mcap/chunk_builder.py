"""Build chunks of MCAP messages in bulk.

Writing one message at a time takes several microseconds in Python, and a run has 100,000 messages
per second. So messages are collected, and numpy lays out a whole chunk of them with its message
indexes: messages of one size as one structured array, others joined with headers from one array.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.mcap.records import RECORD_HEAD

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
"""``message_sequence`` is MCAP's ``sequence``: messages have a field of that name, too, and share
one layout with it."""


_INDEX_HEAD = struct.Struct("<BQHI")
_INDEX_ENTRY_DTYPE = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
_HEADER_BYTES = MESSAGE_HEADER_DTYPE.itemsize

PendingMessages = list[Any]
"""Messages for the next chunk: channel id, sequence, stamp in ns and data of each. One flat list
contains nothing that the garbage collector must visit."""

PENDING_FIELDS = 4
LARGE_BYTES = 64 << 10
"""Messages from this size on are not copied."""


@dataclass(frozen=True, slots=True)
class ChunkBody:
    """The records of a chunk before compression, and the content of its indexes.

    ``parts`` are the records in pieces: large messages are not copied behind their headers.
    ``indexes`` holds, by ascending channel id, the channel, its number of messages and its
    MessageIndex record. ``rows`` is set if all messages have one size.
    """

    parts: tuple[bytes, ...]
    start_ns: int
    end_ns: int
    indexes: tuple[tuple[int, int, bytes], ...]
    rows: bool = False

    @property
    def size(self) -> int:
        """The size of the records in bytes."""
        return sum(map(len, self.parts))

    @property
    def records(self) -> bytes:
        """The records in one piece."""
        return self.parts[0] if len(self.parts) == 1 else b"".join(self.parts)


def messages_chunk(waiting: PendingMessages) -> ChunkBody:
    """Return the chunk of messages of any size and channel, in order (at least one)."""
    datas: list[bytes] = waiting[3::PENDING_FIELDS]
    count = len(datas)
    channels = np.array(waiting[0::PENDING_FIELDS], dtype="<u2")
    times = np.array(waiting[2::PENDING_FIELDS], dtype="<u8")
    sizes = np.fromiter(map(len, datas), dtype="<u8", count=count) + np.uint64(_HEADER_BYTES)
    headers = np.empty(count, dtype=MESSAGE_HEADER_DTYPE)
    headers["opcode"] = Opcode.MESSAGE
    headers["length"] = sizes - np.uint64(RECORD_HEAD.size)
    headers["channel_id"] = channels
    headers["message_sequence"] = waiting[1::PENDING_FIELDS]
    headers["log_time"] = headers["publish_time"] = times
    pieces = [b""] * (2 * count)
    pieces[0::2] = headers.view(f"V{_HEADER_BYTES}").tolist()
    pieces[1::2] = datas
    offsets = np.cumsum(sizes) - sizes
    indexes = []
    for channel_id in sorted(set(waiting[0::PENDING_FIELDS])):  # np.unique would load numpy.ma
        chosen = channels == channel_id
        indexes.append(_message_index(channel_id, times[chosen], offsets[chosen]))
    parts = _joined(pieces) if int(sizes.max()) >= LARGE_BYTES else (b"".join(pieces),)
    return ChunkBody(parts, int(times.min()), int(times.max()), tuple(indexes))


def _joined(pieces: list[bytes]) -> tuple[bytes, ...]:
    """Join the small pieces between large ones."""
    parts: list[bytes] = []
    small: list[bytes] = []
    for piece in pieces:
        if len(piece) < LARGE_BYTES:
            small.append(piece)
            continue
        parts += [b"".join(small), piece]
        small = []
    return (*parts, b"".join(small)) if small else tuple(parts)


def rows_chunk(messages: npt.NDArray[np.void], channel_id: int) -> ChunkBody:
    """Return the chunk of messages of one size: an array of them with headers.

    The position of a message follows from its number, so the message index has no entries. Its
    record is needed: Foxglove's reader refuses a chunk without one.
    """
    times = messages["log_time"]
    index = (channel_id, len(messages), _index_record(channel_id, b""))
    return ChunkBody((messages.tobytes(),), int(times.min()), int(times.max()), (index,), rows=True)


def _message_index(
    channel_id: int, times: npt.NDArray[np.uint64], offsets: npt.NDArray[np.uint64]
) -> tuple[int, int, bytes]:
    entries = np.empty(len(times), dtype=_INDEX_ENTRY_DTYPE)
    entries["log_time"] = times
    entries["offset"] = offsets
    return channel_id, len(times), _index_record(channel_id, entries.tobytes())


def _index_record(channel_id: int, entries: bytes) -> bytes:
    head = _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel_id, len(entries))
    return head + entries
