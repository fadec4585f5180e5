"""Runs whose programs have other names, two builds of one: where they differ apart from that.

The names are in the trace's own hashes of what a main's construction has made, and so in all chain
hashes after it.
"""

from __future__ import annotations

from rsltrace.diff.alignment.blocks import equal_block
from rsltrace.diff.alignment.rows import Run, load_rows

_ROWS_AT_ONCE = 256


def first_real_difference(run_a: Run, run_b: Run, start: int) -> int | None:
    """Return the index of the first event from ``start`` on that differs in more than names.

    Where one run is the beginning of the other it is the number of events of the shorter one;
    None if they do the same.
    """
    counts = run_a.trace.event_count, run_b.trace.event_count
    index, end = start, min(counts)
    while index < end:
        equal = equal_block(run_a, run_b, index, index)
        if equal is not None:
            index = equal.end_a
            continue
        last = min(index + _ROWS_AT_ONCE, end)
        a, b = (load_rows(run, index, last) for run in (run_a, run_b))
        columns = ("number", "kind", "stamp", "input", "content", "flags", "state", "cause")
        for place in range(last - index):
            if any(getattr(a, name)[place] != getattr(b, name)[place] for name in columns):
                return index + place
        index = last
    return None if counts[0] == counts[1] else end


__all__ = ["first_real_difference"]
