"""Checking a whole trace: every byte against the file's checksum, every event against its hashes.

Reading checks what it reads. This reads everything, and also finds what no single read can see: a
changed environment or job, or events whose hashes are not those of their contents.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from rsltrace.errors import TraceError
from rsltrace.trace.chain import hash64, verify_chain
from rsltrace.trace.format import OUTPUT_DTYPE, OUTPUT_HASHED
from rsltrace.trace.index import TraceIndex
from rsltrace.trace.mcap.records import MAGIC, Damaged, parse_channel, parse_schema
from rsltrace.trace.mcap.source import ByteSource
from rsltrace.trace.mcap.summary import Summary, check_data
from rsltrace.trace.mcap.walk import read_body, walk_records
from rsltrace.trace.pieces import damaged
from rsltrace.trace.segments import SegmentReader

_DEFINITIONS = frozenset((Opcode.SCHEMA, Opcode.CHANNEL))


def check_data_section(source: ByteSource, summary_start: int) -> None:
    """Raise TraceError unless the bytes before the summary have the checksum given there."""
    try:
        check_data(source, summary_start)
    except Damaged as error:
        raise damaged(source, 0, "the data section", error) from error


def check_records(source: ByteSource, index: TraceIndex) -> None:
    """Raise TraceError unless the records before the summary follow each other without a gap, and
    have the channels and schemas that the summary says.

    A checksum may have been made for bytes that are no MCAP file, and who reads a file from its
    start knows no summary.
    """
    told = Summary()
    try:
        for opcode, span in walk_records(source, len(MAGIC), index.summary_start):
            if opcode in _DEFINITIONS:
                _add_once(told, opcode, read_body(source, span, opcode))
    except Damaged as error:
        raise damaged(source, 0, "the data section", error) from error
    found = TraceIndex(complete=True, header=index.header)
    found.take(told)
    if found.channels != index.channels:
        raise damaged(
            source, index.summary_start, "the summary", "its channels are not those before it"
        )


def _add_once(told: Summary, opcode: int, body: bytes) -> None:
    """Add a channel or schema. Raises Damaged if there is another one of its id."""
    if opcode == Opcode.SCHEMA:
        schema = parse_schema(body)
        is_only = told.schemas.setdefault(schema.id, schema) == schema
    else:
        channel = parse_channel(body)
        is_only = told.channels.setdefault(channel.id, channel) == channel
    if not is_only:
        raise Damaged("a channel or schema is defined twice, in two ways")


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
        if not np.array_equal(outputs["event"], np.repeat(events["index"], events["outputs"])):
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
