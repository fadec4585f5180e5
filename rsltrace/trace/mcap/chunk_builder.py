"""Build chunks of MCAP messages in bulk.

Writing one message at a time takes several microseconds in Python, and a run has 100,000 messages
per second. So messages are collected, and numpy makes a whole chunk of them with its message
indexes: messages of one size as one structured array, others from records that are ready.
"""

from __future__ import annotations

import struct

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


def messages_chunk(headers: bytes, parts: tuple[bytes, ...]) -> ChunkBody:
    """Return the chunk of messages of any size and channel (at least one).

    ``headers`` are all of them in order, ``parts`` the records, as in ChunkBody.
    """
    messages = np.frombuffer(headers, dtype=MESSAGE_HEADER_DTYPE)
    ends = np.cumsum(messages["length"] + np.uint64(RECORD_HEAD.size))
    assert int(ends[-1]) == sum(map(len, parts)), "messages do not match their headers"
    entries = np.zeros((len(messages), 2), dtype="<u8")
    entries[:, 0] = times = messages["log_time"]
    entries[1:, 1] = ends[:-1]
    channels = messages["channel_id"]
    # Sorted at once: in a large graph, a pass over all messages for each channel would take longer
    # than all else here.
    by_channel = entries[np.argsort(channels, kind="stable")].tobytes()
    indexes, end = [], 0
    for channel_id, count in enumerate(np.bincount(channels).tolist()):
        if count:
            start, end = end, end + count * entries[0].nbytes
            indexes.append((channel_id, count, _index_record(channel_id, by_channel[start:end])))
    return ChunkBody(parts, int(times.min()), int(times.max()), tuple(indexes))


def joined(pieces: list[bytes]) -> tuple[bytes, ...]:
    """Join header and data of messages, the small pieces between large ones."""
    if pieces and max(map(len, pieces[1::2])) < LARGE_BYTES:
        return (b"".join(pieces),)
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


def _index_record(channel_id: int, entries: bytes) -> bytes:
    head = _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel_id, len(entries))
    return head + entries
