"""Events and outputs of a trace, a segment at a time: arrays of records of one size.

Reading a segment means: fetch, decompress, check the CRC, view the bytes as a numpy array. Nothing
is parsed or copied per event. Writing copies contiguous fields in one piece: for numpy each field
is a loop over the array.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from rsltrace.errors import TraceError
from rsltrace.trace.chain import hash64, verify_chain
from rsltrace.trace.dtypes import (
    EVENT_DTYPE,
    EVENT_MESSAGE_DTYPE,
    OUTPUT_CONTENT_DTYPE,
    OUTPUT_DTYPE,
    OUTPUT_MESSAGE_DTYPE,
    SEGMENT_DTYPE,
)
from rsltrace.trace.format import CDR_HEADER, OUTPUT_HASHED
from rsltrace.trace.index import SegmentTable, damage_error, read_chunk
from rsltrace.trace.mcap.chunk_builder import MESSAGE_HEADER_DTYPE, ChunkBody, rows_chunk
from rsltrace.trace.mcap.records import MESSAGE, MESSAGE_HEAD, RECORD_HEAD, DamageError, RecordSpan
from rsltrace.trace.mcap.source import ByteSource
from rsltrace.trace.model.event import (
    NO_SEQUENCE,
    EventFlag,
    EventKind,
    EventRecord,
    Output,
    OutputKind,
)

_FRONT = ("front", f"V{MESSAGE_HEADER_DTYPE.itemsize + len(CDR_HEADER)}")
_EVENT_PARTS = np.dtype([_FRONT, ("event", f"V{EVENT_DTYPE.itemsize}")])
_OUTPUT_PARTS = np.dtype(
    [
        _FRONT,
        ("event", "<u8"),
        ("content", f"V{OUTPUT_CONTENT_DTYPE.itemsize}"),
        ("sequence", "<u4"),
    ]
)


def events_chunk(events: npt.NDArray[np.void], channel_id: int) -> ChunkBody:
    """Return the chunk of a segment's events: EVENT_DTYPE, contiguous. A message's time is its
    event's stamp."""
    messages = _messages(len(events), EVENT_MESSAGE_DTYPE, channel_id)
    messages.view(_EVENT_PARTS)["event"] = events.view(_EVENT_PARTS["event"])
    messages["message_sequence"] = events["index"].astype("<u4")
    messages["log_time"] = messages["publish_time"] = events["stamp"]
    return rows_chunk(messages, channel_id)


def outputs_chunk(
    contents: bytes,
    sequences: bytes,
    events: npt.NDArray[np.void],
    first_output: int,
    channel_id: int,
) -> ChunkBody:
    """Return the chunk of a segment's outputs; a message's time is the stamp of its event.

    ``contents`` are packed OUTPUT_CONTENT, ``sequences`` those of all outputs except draws,
    ``events`` the segment's; ``first_output`` is the number of outputs before them.
    """
    packed = np.frombuffer(contents, dtype=OUTPUT_CONTENT_DTYPE)
    numbered = packed["kind"] != OutputKind.DRAW
    numbers = np.frombuffer(sequences, dtype="<u4")
    assert np.count_nonzero(numbered) == len(numbers), "outputs do not match their sequences"
    messages = _messages(len(packed), OUTPUT_MESSAGE_DTYPE, channel_id)
    parts = messages.view(_OUTPUT_PARTS)
    parts["content"] = packed.view(_OUTPUT_PARTS["content"])
    parts["event"] = np.repeat(events["index"], events["outputs"])
    parts["sequence"] = NO_SEQUENCE
    parts["sequence"][numbered] = numbers
    places = np.arange(first_output, first_output + len(packed), dtype="<u8")
    messages["message_sequence"] = places.astype("<u4")
    messages["log_time"] = messages["publish_time"] = np.repeat(events["stamp"], events["outputs"])
    return rows_chunk(messages, channel_id)


def _messages(count: int, layout: np.dtype[np.void], channel_id: int) -> npt.NDArray[np.void]:
    """Return messages of ``layout``; the caller sets sequence, times and content."""
    head = MESSAGE_HEAD.pack(MESSAGE, layout.itemsize - RECORD_HEAD.size, channel_id, 0, 0, 0)
    # np.empty would be as slow: it clears an array of structures.
    return np.frombuffer(bytearray(head + CDR_HEADER).ljust(layout.itemsize, b"\0") * count, layout)


_CDR_LITTLE_ENDIAN = b"\x00\x01"
"""The CDR header in numpy, which drops zeros at the end."""

_SEGMENTS_CACHED = 4
"""For single events: a diff goes back and forth between two or three places."""


def events_in(records: bytes, channel_id: int) -> npt.NDArray[np.void]:
    """Return the events of a chunk as EVENT_DTYPE, shape (n,), in place. Raises DamageError."""
    return _bodies(records, EVENT_MESSAGE_DTYPE, EVENT_DTYPE, channel_id)


def outputs_in(records: bytes, channel_id: int) -> npt.NDArray[np.void]:
    """Return the outputs of a chunk as OUTPUT_DTYPE, shape (n,), in place. Raises DamageError."""
    return _bodies(records, OUTPUT_MESSAGE_DTYPE, OUTPUT_DTYPE, channel_id)


def check_numbered(events: npt.NDArray[np.void], first: int) -> None:
    """Raise DamageError unless the events are numbered ``first``, ``first + 1``, …"""
    numbers = np.arange(first, first + len(events), dtype=np.uint64)
    if not np.array_equal(events["index"], numbers):
        raise DamageError(f"its events are not numbered from {first} on")


def _bodies(
    records: bytes, message: np.dtype[np.void], body: np.dtype[np.void], channel_id: int
) -> npt.NDArray[np.void]:
    if len(records) % message.itemsize:
        raise DamageError("its length is not a multiple of that of a message")
    messages = np.frombuffer(records, dtype=message)
    sound = (
        (messages["opcode"] == int(Opcode.MESSAGE))
        & (messages["length"] == message.itemsize - RECORD_HEAD.size)
        & (messages["channel_id"] == channel_id)
        & (messages["cdr"] == _CDR_LITTLE_ENDIAN)
    )
    if not sound.all():
        raise DamageError("it holds other messages than it should")
    bodies: npt.NDArray[np.void] = np.ndarray(
        shape=messages.shape,
        dtype=body,
        buffer=records,
        offset=message.itemsize - body.itemsize,
        strides=(message.itemsize,),
    )
    return bodies


class SegmentReader:
    """Reads segments by number. ``table`` is SEGMENT_DTYPE, shape (segments,)."""

    def __init__(
        self,
        source: ByteSource,
        table: SegmentTable,
        event_channel: int,
        output_channel: int,
    ) -> None:
        self.table = np.frombuffer(table.packed, dtype=SEGMENT_DTYPE)
        self._source = source
        self._event_channel = event_channel
        self._output_channel = output_channel
        self._first_events = self.table["first_event"]
        # Caches per object, so that they end with the trace.
        self.cached_events = lru_cache(maxsize=_SEGMENTS_CACHED)(self.events)
        self.cached_outputs = lru_cache(maxsize=_SEGMENTS_CACHED)(self.outputs)

    def forget(self) -> None:
        self.cached_events.cache_clear()
        self.cached_outputs.cache_clear()

    def segment_of(self, event: int) -> int:
        """Return the number of the segment that contains ``event`` (which must exist)."""
        return int(np.searchsorted(self._first_events, np.uint64(event), side="right")) - 1

    def event(self, segment: int, index: int) -> EventRecord:
        row = self.cached_events(segment)[index - int(self._first_events[segment])]
        return event_of(row, self._source.name)

    def outputs_of(self, segment: int, index: int) -> list[Output]:
        """Return the outputs of an event of a segment, in order. Raises TraceError."""
        rows = self.outputs_between(segment, index, index + 1)
        return [output_of(row, self._source.name) for row in rows]

    def outputs_between(self, segment: int, first: int, last: int) -> npt.NDArray[np.void]:
        """Return the outputs of the events ``first <= index < last`` of a segment: OUTPUT_DTYPE,
        shape (n,). Raises TraceError."""
        outputs = self.cached_outputs(segment)
        bounds = np.array([first, last], dtype=np.uint64)
        low, high = np.searchsorted(outputs["event"], bounds).tolist()
        return outputs[low:high]

    def events(self, segment: int) -> npt.NDArray[np.void]:
        """Return the events of a segment: EVENT_DTYPE, shape (n,), read-only. Raises TraceError."""
        row = self.table[segment]
        span = RecordSpan(int(row["events_offset"]), int(row["events_length"]))
        try:
            # The table's counts limit the memory.
            size_max = int(row["events"]) * EVENT_MESSAGE_DTYPE.itemsize
            events = events_in(read_chunk(self._source, span, size_max), self._event_channel)
            if len(events) != row["events"] or events["chain_hash"][-1] != row["chain_hash"]:
                raise DamageError("it is not the chunk of the index")
            check_numbered(events, int(row["first_event"]))
        except DamageError as error:
            raise damage_error(self._source, span.offset, "the events chunk", error) from error
        return events

    def outputs(self, segment: int) -> npt.NDArray[np.void]:
        """Return the outputs of a segment: OUTPUT_DTYPE, shape (n,). Raises TraceError."""
        row = self.table[segment]
        if not row["outputs"]:
            return np.zeros(0, dtype=OUTPUT_DTYPE)
        span = RecordSpan(int(row["outputs_offset"]), int(row["outputs_length"]))
        try:
            size_max = int(row["outputs"]) * OUTPUT_MESSAGE_DTYPE.itemsize
            outputs = outputs_in(read_chunk(self._source, span, size_max), self._output_channel)
            owners = outputs["event"]
            first = int(row["first_event"])
            if (
                len(outputs) != row["outputs"]
                or owners[0] < first
                or owners[-1] >= first + int(row["events"])
                or (owners[1:] < owners[:-1]).any()
            ):
                raise DamageError("it is not the chunk of the index")
        except DamageError as error:
            raise damage_error(self._source, span.offset, "the outputs chunk", error) from error
        return outputs


def check_hashes(source: ByteSource, segments: SegmentReader) -> None:
    """Raise TraceError unless all chain hashes and output hashes follow from the contents."""
    previous = 0
    for segment in range(len(segments.table)):
        events = segments.events(segment)
        wrong = verify_chain(events, previous)
        if wrong is not None:
            raise TraceError(
                f"{source.name}: the chain hash of event {events[wrong]['index']} is not that of "
                "its contents; the trace was changed after it was recorded"
            )
        previous = int(events["chain_hash"][-1])
        outputs = segments.outputs(segment)
        counts = events["outputs"]
        if sum(counts.tolist()) != len(outputs) or not np.array_equal(
            outputs["event"], np.repeat(events["index"], counts)
        ):
            raise TraceError(
                f"{source.name}: the outputs of the events from {events[0]['index']} on are not "
                "as many as the events say; the trace was changed after it was recorded"
            )
        _check_output_hashes(source, events, outputs)


def _check_output_hashes(
    source: ByteSource, events: npt.NDArray[np.void], outputs: npt.NDArray[np.void]
) -> None:
    packed = np.ascontiguousarray(outputs, dtype=OUTPUT_DTYPE).tobytes()
    size = OUTPUT_DTYPE.itemsize
    position = 0
    rows = zip(events["outputs"].tolist(), events["output_hash"].tolist(), strict=True)
    for number, (count, expected) in enumerate(rows):
        folded = 0
        for _ in range(count):
            folded = hash64(packed[position : position + size][OUTPUT_HASHED], folded)
            position += size
        if folded != expected:
            raise TraceError(
                f"{source.name}: the output hash of event {events[number]['index']} is not that of "
                "its outputs; the trace was changed after it was recorded"
            )


def segment_row(
    events: npt.NDArray[np.void],
    outputs: int,
    firsts: tuple[int, int],
    events_span: tuple[int, int],
    outputs_span: tuple[int, int],
) -> npt.NDArray[np.void]:
    """Return the row of a segment: SEGMENT_DTYPE, shape (1,).

    ``outputs`` is their number, ``firsts`` the numbers of events and outputs before the segment;
    the spans are (offset, length) of the chunks.
    """
    row = np.zeros(1, dtype=SEGMENT_DTYPE)
    row["first_event"], row["first_output"] = firsts
    row["events"], row["outputs"] = len(events), outputs
    row["chain_hash"] = events["chain_hash"][-1]
    row["start_stamp"], row["end_stamp"] = events["stamp"].min(), events["stamp"].max()
    row["events_offset"], row["events_length"] = events_span
    row["outputs_offset"], row["outputs_length"] = outputs_span
    return row


def event_of(row: np.void, name: str = "trace") -> EventRecord:
    """Return a row of EVENT_DTYPE, from the file ``name``, as an EventRecord. Raises TraceError."""
    chain_hash, index, stamp, cause, hash_in, hash_out, state, entity, nth, outputs, kind, flags = (
        row.item()
    )
    try:
        return EventRecord(
            index=index,
            stamp_ns=stamp,
            entity=entity,
            kind=EventKind(kind),
            flags=EventFlag(flags),
            cause_event=cause,
            cause_output=nth,
            outputs=outputs,
            input_hash=hash_in,
            output_hash=hash_out,
            state_hash=state,
            chain_hash=chain_hash,
        )
    except ValueError as error:
        raise TraceError(
            f"{name}: event {index}: {error}; a newer rsltrace wrote this trace"
        ) from error


def output_of(row: np.void, name: str = "trace") -> Output:
    """Return a row of OUTPUT_DTYPE, from the file ``name``, as an Output. Raises TraceError."""
    event, content_hash, entity, kind, sequence = row.item()
    try:
        return Output(event, entity, OutputKind(kind), content_hash, sequence)
    except ValueError as error:
        raise TraceError(
            f"{name}: an output of event {event}: {error}; a newer rsltrace wrote this trace"
        ) from error
