"""Checking a whole trace: every byte against the file's checksum, every event against its hashes.

Reading checks what it reads. This reads everything, and also finds what no single read can see: a
changed environment or job, or events whose hashes are not those of their contents.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.mcap.records import MAGIC, Damaged
from rsltrace.mcap.source import ByteSource
from rsltrace.mcap.summary import check_data
from rsltrace.mcap.walk import walk_records
from rsltrace.trace.chain import hash64, verify_chain
from rsltrace.trace.format import OUTPUT_DTYPE, OUTPUT_HASHED
from rsltrace.trace.pieces import damaged
from rsltrace.trace.segments import SegmentReader


def check_data_section(source: ByteSource, summary_start: int) -> None:
    """Raise TraceError unless the bytes before the summary have the checksum given there."""
    try:
        check_data(source, summary_start)
    except Damaged as error:
        raise damaged(source, 0, "the data section", error) from error


def check_records(source: ByteSource, summary_start: int) -> None:
    """Raise TraceError unless the records before the summary follow each other without a gap.

    A checksum may have been made for bytes that are no MCAP file.
    """
    try:
        for _ in walk_records(source, len(MAGIC), summary_start):
            pass
    except Damaged as error:
        raise damaged(source, 0, "the data section", error) from error


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
