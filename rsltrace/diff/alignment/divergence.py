"""Where two runs diverge: a binary search over chain hashes, which cover all events before.

Both files carry the chain hash at the end of each segment. Where they end a segment at the same
event, as two recordings of one job do, no event is read until the one segment is found that holds
the difference. Where they are cut differently, each step of the search reads one segment. Equal
runs are found so without loading numpy.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING

from rsltrace.trace.reader import Trace

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


def first_difference(a: Trace, b: Trace) -> int | None:
    """Return the index of the first event that differs in any way, or None if none does.

    Where one run is the beginning of the other it is the number of events of the shorter one.
    Raises TraceError if a segment that has to be read is damaged.
    """
    count_a, count_b = a.event_count, b.event_count
    if count_a == count_b and a.digest == b.digest:
        return None
    low, high = _between_common_ends(a, b)
    # Two runs agree up to an event if their chain hashes agree there; that is so up to ``low``
    # and, if ``high`` is an event of both, not so there. Every end of a segment is a try for free
    # in the one trace and one segment to read in the other.
    for known, other in ((a, b), (b, a)):
        low, high = _narrow(known, other, low, high)
    for mine, theirs in _pieces(a, b, low, high):
        differ = mine["chain_hash"] != theirs["chain_hash"]
        if differ.any():
            return int(mine["index"][int(differ.argmax())])
    return high


def _between_common_ends(a: Trace, b: Trace) -> tuple[int, int]:
    """Return (events that surely agree, events among which the difference is), at segment ends."""
    hashes = dict(_ends(b))
    low = 0
    for end, chain_hash in _ends(a):
        if hashes.get(end, chain_hash) != chain_hash:
            return low, end
        if end in hashes:
            low = end
    return low, min(a.event_count, b.event_count)


def _narrow(known: Trace, other: Trace, low: int, high: int) -> tuple[int, int]:
    """Bisect over the ends of ``known``'s segments that lie between ``low`` and ``high``."""
    ends = _ends(known)
    begin, end = (bisect_right(ends, events, key=lambda row: row[0]) for events in (low, high))
    while begin < end:
        middle = (begin + end) // 2
        events, chain_hash = ends[middle]
        if events >= high:
            end = middle
        elif chain_hash == other.event(events - 1).chain_hash:
            low, begin = events, middle + 1
        else:
            high, end = events, middle
    return low, high


def _pieces(
    a: Trace, b: Trace, low: int, high: int
) -> list[tuple[npt.NDArray[np.void], npt.NDArray[np.void]]]:
    """Return the events ``low <= index < high`` of both; by now they lie in one segment each."""
    return list(zip(a.events(low, high), b.events(low, high), strict=True))


def _ends(trace: Trace) -> list[tuple[int, int]]:
    """Return how many events there are up to the end of each segment, and its chain hash."""
    table = trace.segments
    ends = (table["first_event"] + table["events"]).tolist()
    return list(zip(ends, table["chain_hash"].tolist(), strict=True))
