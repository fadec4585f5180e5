"""Bodies of MCAP chunks, built in bulk.

Writing a message at a time costs several microseconds in Python; a run has 100,000 messages a
second. So messages are collected as they come and a whole chunk of them is laid out by numpy:
events and outputs have a fixed size and are one structured array, payloads are joined with headers
that were made as one array. The message indexes of a chunk are made the same way.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from rsltrace.trace.format import (
    CDR_HEADER,
    EVENT_DTYPE,
    EVENT_MESSAGE_DTYPE,
    EVENT_REST_DTYPE,
    MESSAGE_HEADER_DTYPE,
    OUTPUT_DTYPE,
    OUTPUT_MESSAGE_DTYPE,
)

RECORD_HEAD_BYTES = 9
"""Opcode (u8) and length (u64) of every MCAP record; the length does not count them."""

_SEQUENCE_MASK = 2**32 - 1
_INDEX_HEAD = struct.Struct("<BQHI")
_INDEX_ENTRY_DTYPE = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
_MESSAGE_HEADER = struct.Struct("<BQHIQQ")
assert _MESSAGE_HEADER.size == MESSAGE_HEADER_DTYPE.itemsize

Payload = tuple[int, int, int, bytes]
"""(channel id, sequence, stamp in ns, data) of a message that waits for its chunk."""


@dataclass(frozen=True, slots=True)
class ChunkBody:
    """The records of a chunk before compression, and what its indexes say.

    ``start_ns`` and ``end_ns`` are the smallest and largest log times. ``indexes`` holds, by
    ascending channel id, the channel, its number of messages and its MessageIndex record.
    """

    records: bytes
    start_ns: int
    end_ns: int
    indexes: tuple[tuple[int, int, bytes], ...]


def event_rows(rests: Sequence[bytes], chain_hashes: array[int]) -> npt.NDArray[np.void]:
    """Return the events as an array of EVENT_DTYPE, shape (n,). ``rests`` are EVENT_REST packed."""
    packed = np.frombuffer(b"".join(rests), dtype=EVENT_REST_DTYPE)
    assert len(packed) == len(chain_hashes)
    rows = np.empty(len(packed), dtype=EVENT_DTYPE)
    rows["chain_hash"] = chain_hashes
    for name in EVENT_REST_DTYPE.fields or ():
        rows[name] = packed[name]
    return rows


def events_chunk(rows: npt.NDArray[np.void], channel_id: int) -> ChunkBody:
    """Return the chunk of a segment's events; a message's time is its event's stamp."""
    messages = _fixed_size_messages(rows, EVENT_MESSAGE_DTYPE, channel_id)
    messages["message_sequence"] = rows["index"] & np.uint64(_SEQUENCE_MASK)
    messages["log_time"] = messages["publish_time"] = rows["stamp"]
    return _fixed_size_chunk(messages, channel_id)


def outputs_chunk(
    rows: npt.NDArray[np.void],
    events: npt.NDArray[np.void],
    first_output: int,
    channel_id: int,
) -> ChunkBody:
    """Return the chunk of a segment's outputs; a message's time is the stamp of its event.

    ``rows`` are OUTPUT_DTYPE, ``events`` the EVENT_DTYPE rows of the segment they belong to, and
    ``first_output`` counts the outputs of the run before them.
    """
    messages = _fixed_size_messages(rows, OUTPUT_MESSAGE_DTYPE, channel_id)
    numbers = np.arange(first_output, first_output + len(rows), dtype=np.uint64)
    messages["message_sequence"] = numbers & np.uint64(_SEQUENCE_MASK)
    stamps = np.repeat(events["stamp"], events["outputs"])
    messages["log_time"] = messages["publish_time"] = stamps
    return _fixed_size_chunk(messages, channel_id)


def payloads_chunk(pending: Sequence[Payload]) -> ChunkBody:
    """Return the chunk of messages of any size and channel, in the order given (at least one)."""
    pack = _MESSAGE_HEADER.pack
    opcode = int(Opcode.MESSAGE)  # packing an enum member takes as long as all the rest
    fixed = _MESSAGE_HEADER.size - RECORD_HEAD_BYTES
    packed = [
        pack(opcode, fixed + len(data), channel_id, sequence, stamp_ns, stamp_ns)
        for channel_id, sequence, stamp_ns, data in pending
    ]
    pieces = [b""] * (2 * len(pending))
    pieces[0::2] = packed
    pieces[1::2] = [data for _, _, _, data in pending]
    headers = np.frombuffer(b"".join(packed), dtype=MESSAGE_HEADER_DTYPE)
    ends = np.cumsum(headers["length"] + np.uint64(RECORD_HEAD_BYTES))
    offsets = np.concatenate((np.zeros(1, dtype=np.uint64), ends[:-1]))
    times = headers["log_time"]
    indexes = []
    for channel_id in np.unique(headers["channel_id"]).tolist():
        chosen = headers["channel_id"] == channel_id
        indexes.append(_message_index(channel_id, times[chosen], offsets[chosen]))
    return ChunkBody(b"".join(pieces), int(times.min()), int(times.max()), tuple(indexes))


def _fixed_size_messages(
    rows: npt.NDArray[np.void], layout: np.dtype[np.void], channel_id: int
) -> npt.NDArray[np.void]:
    """Return messages of ``layout`` around ``rows``; sequence and times are left to the caller."""
    messages = np.empty(len(rows), dtype=layout)
    messages["opcode"] = Opcode.MESSAGE
    messages["length"] = layout.itemsize - RECORD_HEAD_BYTES
    messages["channel_id"] = channel_id
    messages["cdr"] = CDR_HEADER
    for name in rows.dtype.names or ():
        messages[name] = rows[name]
    return messages


def _fixed_size_chunk(messages: npt.NDArray[np.void], channel_id: int) -> ChunkBody:
    size = messages.dtype.itemsize
    times = messages["log_time"]
    offsets = np.arange(0, len(messages) * size, size, dtype=np.uint64)
    index = _message_index(channel_id, times, offsets)
    return ChunkBody(messages.tobytes(), int(times.min()), int(times.max()), (index,))


def _message_index(
    channel_id: int, times: npt.NDArray[np.uint64], offsets: npt.NDArray[np.uint64]
) -> tuple[int, int, bytes]:
    entries = np.empty(len(times), dtype=_INDEX_ENTRY_DTYPE)
    entries["log_time"] = times
    entries["offset"] = offsets
    head = _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + entries.nbytes, channel_id, entries.nbytes)
    return channel_id, len(times), head + entries.tobytes()


def output_rows(packed: Sequence[bytes]) -> npt.NDArray[np.void]:
    """Return the outputs as an array of OUTPUT_DTYPE, shape (n,). ``packed`` are OUTPUT packed."""
    return np.frombuffer(b"".join(packed), dtype=OUTPUT_DTYPE)
