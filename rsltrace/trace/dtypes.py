"""The fixed-size messages of ``format`` as numpy has them.

Apart from it, since a command that reads no event starts in half the time without numpy.
"""

from __future__ import annotations

import numpy as np

from rsltrace.trace.format import SEGMENT_COLUMNS
from rsltrace.trace.mcap.chunk_builder import MESSAGE_HEADER_DTYPE

EVENT_REST_DTYPE = np.dtype(
    [
        ("index", "<u8"),
        ("stamp", "<u8"),
        ("cause_event", "<u8"),
        ("input_hash", "<u8"),
        ("output_hash", "<u8"),
        ("state_hash", "<u8"),
        ("entity", "<u4"),
        ("cause_output", "<u4"),
        ("outputs", "<u4"),
        ("kind", "u1"),
        ("flags", "u1"),
    ]
)
EVENT_DTYPE = np.dtype([("chain_hash", "<u8"), *EVENT_REST_DTYPE.descr])

OUTPUT_CONTENT_DTYPE = np.dtype([("hash", "<u8"), ("entity", "<u4"), ("kind", "<u4")])
OUTPUT_DTYPE = np.dtype([("event", "<u8"), *OUTPUT_CONTENT_DTYPE.descr, ("sequence", "<u4")])

TIMING_DTYPE = np.dtype(
    [
        ("event", "<u8"),
        ("steady", "<u8"),
        ("wall", "<u8"),
        ("duration", "<u8"),
        ("observer", "<u8"),
        ("source", "<u8"),
        ("ready", "<u8"),
        ("sequence", "<u8"),
        ("thread", "<u4"),
    ]
)

EVENT_MESSAGE_DTYPE = np.dtype([*MESSAGE_HEADER_DTYPE.descr, ("cdr", "S4"), *EVENT_DTYPE.descr])
OUTPUT_MESSAGE_DTYPE = np.dtype([*MESSAGE_HEADER_DTYPE.descr, ("cdr", "S4"), *OUTPUT_DTYPE.descr])

SEGMENT_DTYPE = np.dtype([(name, "<u8") for name in SEGMENT_COLUMNS])
