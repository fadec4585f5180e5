"""Bodies of MCAP chunks, built in bulk.

Writing a message at a time costs several microseconds in Python; a run has 100,000 messages a
second. So messages are collected as they come and a whole chunk of them is laid out by numpy:
events and outputs have a fixed size and are one structured array, payloads are joined with headers
that were made as one array. The message indexes of a chunk are made the same way. What stays
together is copied in one piece: to numpy a field is a loop over the array.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from rsltrace.model.event import NO_SEQUENCE, OutputKind
from rsltrace.trace.format import (
    CDR_HEADER,
    EVENT_DTYPE,
    EVENT_MESSAGE_DTYPE,
    EVENT_REST_DTYPE,
    MESSAGE_HEADER_DTYPE,
    OUTPUT_CONTENT_DTYPE,
    OUTPUT_DTYPE,
    OUTPUT_MESSAGE_DTYPE,
)

RECORD_HEAD_BYTES = 9
"""Opcode (u8) and length (u64) of every MCAP record; the length does not count them."""

_SEQUENCE_MASK = 2**32 - 1
_INDEX_HEAD = struct.Struct("<BQHI")
_INDEX_ENTRY_DTYPE = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
_HEADER_BYTES = MESSAGE_HEADER_DTYPE.itemsize
_MESSAGE_HEADER = struct.Struct(f"{_HEADER_BYTES}s")
_CHAINED_DTYPE = np.dtype([("chain_hash", "<u8"), ("rest", f"V{EVENT_REST_DTYPE.itemsize}")])
_NUMBERED_DTYPE = np.dtype(
    [("event", "<u8"), ("content", f"V{OUTPUT_CONTENT_DTYPE.itemsize}"), ("sequence", "<u4")]
)
assert _CHAINED_DTYPE.itemsize == EVENT_DTYPE.itemsize
assert _NUMBERED_DTYPE.itemsize == OUTPUT_DTYPE.itemsize

Waiting = list[Any]
"""Messages that wait for their chunk: channel id, sequence, stamp in ns and data of the first, then
of the second, and so on. One flat list holds nothing that the garbage collector has to visit."""

WAITING_FIELDS = 4


@dataclass(frozen=True, slots=True)
class ChunkBody:
    """The records of a chunk before compression, and what its indexes say.

    ``start_ns`` and ``end_ns`` are the smallest and largest log times. ``indexes`` holds, by
    ascending channel id, the channel, its number of messages and its MessageIndex record.
    ``rows`` says that all messages have one size.
    """

    records: bytes
    start_ns: int
    end_ns: int
    indexes: tuple[tuple[int, int, bytes], ...]
    rows: bool = False


def event_rows(rests: Sequence[bytes], chain_hashes: array[int]) -> npt.NDArray[np.void]:
    """Return the events as an array of EVENT_DTYPE, shape (n,). ``rests`` are EVENT_REST packed."""
    assert len(rests) == len(chain_hashes)
    rows = np.empty(len(rests), dtype=_CHAINED_DTYPE)
    rows["chain_hash"] = chain_hashes
    rows["rest"] = np.frombuffer(b"".join(rests), dtype=_CHAINED_DTYPE["rest"])
    return rows.view(EVENT_DTYPE)


def output_rows(
    contents: Sequence[bytes], sequences: array[int], events: npt.NDArray[np.void]
) -> npt.NDArray[np.void]:
    """Return the outputs of ``events`` as an array of OUTPUT_DTYPE, shape (n,).

    ``contents`` are OUTPUT_CONTENT packed, ``sequences`` those of all outputs but draws.
    """
    packed, numbered = _contents(contents)
    owners = np.repeat(events["index"], events["outputs"])
    assert len(owners) == len(packed), "outputs do not match their events"
    assert np.count_nonzero(numbered) == len(sequences), "outputs do not match their sequences"
    rows = np.empty(len(packed), dtype=_NUMBERED_DTYPE)
    rows["event"] = owners
    rows["content"] = packed.view(_NUMBERED_DTYPE["content"])
    sequence = np.full(len(packed), NO_SEQUENCE, dtype="<u4")
    sequence[numbered] = sequences
    rows["sequence"] = sequence
    return rows.view(OUTPUT_DTYPE)


def count_numbered(contents: Sequence[bytes]) -> int:
    """Return how many of these outputs have a sequence."""
    return int(np.count_nonzero(_contents(contents)[1]))


def _contents(
    contents: Sequence[bytes],
) -> tuple[npt.NDArray[np.void], npt.NDArray[np.bool_]]:
    """Return outputs as an array of OUTPUT_CONTENT_DTYPE, and which of them have a sequence."""
    packed = np.frombuffer(b"".join(contents), dtype=OUTPUT_CONTENT_DTYPE)
    return packed, packed["kind"] != OutputKind.DRAW


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


def payloads_chunk(waiting: Waiting) -> ChunkBody:
    """Return the chunk of messages of any size and channel, in the order given (at least one)."""
    datas: list[bytes] = waiting[3::WAITING_FIELDS]
    count = len(datas)
    channels = np.array(waiting[0::WAITING_FIELDS], dtype="<u2")
    times = np.array(waiting[2::WAITING_FIELDS], dtype="<u8")
    sizes = np.fromiter(map(len, datas), dtype="<u8", count=count) + np.uint64(_HEADER_BYTES)
    headers = np.empty(count, dtype=MESSAGE_HEADER_DTYPE)
    headers["opcode"] = Opcode.MESSAGE
    headers["length"] = sizes - np.uint64(RECORD_HEAD_BYTES)
    headers["channel_id"] = channels
    headers["message_sequence"] = waiting[1::WAITING_FIELDS]
    headers["log_time"] = headers["publish_time"] = times
    pieces = [b""] * (2 * count)
    pieces[0::2] = [header for (header,) in _MESSAGE_HEADER.iter_unpack(headers.tobytes())]
    pieces[1::2] = datas
    offsets = np.cumsum(sizes) - sizes
    indexes = []
    for channel_id in np.unique(channels).tolist():
        chosen = channels == channel_id
        indexes.append(_message_index(channel_id, times[chosen], offsets[chosen]))
    return ChunkBody(b"".join(pieces), int(times.min()), int(times.max()), tuple(indexes))


def _fixed_size_messages(
    rows: npt.NDArray[np.void], layout: np.dtype[np.void], channel_id: int
) -> npt.NDArray[np.void]:
    """Return messages of ``layout`` around ``rows``; sequence and times are left to the caller."""
    head = np.zeros(1, dtype=layout)
    head["opcode"] = Opcode.MESSAGE
    head["length"] = layout.itemsize - RECORD_HEAD_BYTES
    head["channel_id"] = channel_id
    head["cdr"] = CDR_HEADER
    whole = np.dtype(f"V{layout.itemsize}")
    row = np.dtype(f"V{rows.dtype.itemsize}")
    messages = np.empty(len(rows), dtype=layout)
    messages.view(whole)[:] = head.view(whole)
    messages.view([("head", f"V{whole.itemsize - row.itemsize}"), ("row", row)])["row"] = rows.view(
        row
    )
    return messages


def _fixed_size_chunk(messages: npt.NDArray[np.void], channel_id: int) -> ChunkBody:
    size = messages.dtype.itemsize
    times = messages["log_time"]
    offsets = np.arange(0, len(messages) * size, size, dtype=np.uint64)
    index = _message_index(channel_id, times, offsets)
    return ChunkBody(messages.tobytes(), int(times.min()), int(times.max()), (index,), rows=True)


def _message_index(
    channel_id: int, times: npt.NDArray[np.uint64], offsets: npt.NDArray[np.uint64]
) -> tuple[int, int, bytes]:
    entries = np.empty(len(times), dtype=_INDEX_ENTRY_DTYPE)
    entries["log_time"] = times
    entries["offset"] = offsets
    head = _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + entries.nbytes, channel_id, entries.nbytes)
    return channel_id, len(times), head + entries.tobytes()
