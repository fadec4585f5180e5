"""The chunks of events and of outputs: rows of one size, made as arrays.

What stays together is copied in one piece: to numpy a field is a loop over the array.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rsltrace.trace.format import (
    CDR_HEADER,
    EVENT_DTYPE,
    EVENT_MESSAGE_DTYPE,
    EVENT_REST_DTYPE,
    OUTPUT_CONTENT_DTYPE,
    OUTPUT_DTYPE,
    OUTPUT_MESSAGE_DTYPE,
)
from rsltrace.trace.mcap.chunk_body import ChunkBody, rows_chunk
from rsltrace.trace.mcap.records import MESSAGE, RECORD_HEAD
from rsltrace.trace.model.event import NO_SEQUENCE, OutputKind

_SEQUENCE_MASK = 2**32 - 1
_CHAINED_DTYPE = np.dtype([("chain_hash", "<u8"), ("rest", f"V{EVENT_REST_DTYPE.itemsize}")])
_NUMBERED_DTYPE = np.dtype(
    [("event", "<u8"), ("content", f"V{OUTPUT_CONTENT_DTYPE.itemsize}"), ("sequence", "<u4")]
)
assert _CHAINED_DTYPE.itemsize == EVENT_DTYPE.itemsize
assert _NUMBERED_DTYPE.itemsize == OUTPUT_DTYPE.itemsize


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
    messages = _messages(rows, EVENT_MESSAGE_DTYPE, channel_id)
    messages["message_sequence"] = rows["index"] & np.uint64(_SEQUENCE_MASK)
    messages["log_time"] = messages["publish_time"] = rows["stamp"]
    return rows_chunk(messages, channel_id)


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
    messages = _messages(rows, OUTPUT_MESSAGE_DTYPE, channel_id)
    numbers = np.arange(first_output, first_output + len(rows), dtype=np.uint64)
    messages["message_sequence"] = numbers & np.uint64(_SEQUENCE_MASK)
    stamps = np.repeat(events["stamp"], events["outputs"])
    messages["log_time"] = messages["publish_time"] = stamps
    return rows_chunk(messages, channel_id)


def _messages(
    rows: npt.NDArray[np.void], layout: np.dtype[np.void], channel_id: int
) -> npt.NDArray[np.void]:
    """Return messages of ``layout`` around ``rows``; sequence and times are left to the caller."""
    head = np.zeros(1, dtype=layout)
    head["opcode"] = MESSAGE
    head["length"] = layout.itemsize - RECORD_HEAD.size
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
