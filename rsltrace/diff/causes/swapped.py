"""Two messages of a bag that changed places."""

from __future__ import annotations

from rsltrace.diff.alignment.rows import BAG, Run, load_rows
from rsltrace.diff.result.events import EventView
from rsltrace.model.event import EventKind

_LOOKED_AT_MAX = 1000


def swapped_with(run_a: Run, run_b: Run, a: EventView | None, b: EventView | None) -> int | None:
    """Return when b plays what a plays at the time of ``a``, if at that time b plays what a does
    then: the two are swapped. None if they are not, or if this is no message of a bag."""
    if a is None or b is None or a.kind is not EventKind.BAG or a.stamp_ns == b.stamp_ns:
        return None
    first = min(a.index, b.index)
    played = [
        {
            (rows.stamp[place], rows.input[place])
            for place, kind in enumerate(rows.kind)
            if kind == BAG and rows.number[place] == run.matching.by_key[a.entity]
        }
        for run in (run_a, run_b)
        for rows in [load_rows(run, first, first + _LOOKED_AT_MAX)]
    ]
    there_a = {content for stamp, content in played[0] if stamp == b.stamp_ns}
    there_b = {content for stamp, content in played[1] if stamp == a.stamp_ns}
    return b.stamp_ns if there_a & there_b else None
