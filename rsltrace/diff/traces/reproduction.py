"""Which of two diverging runs a third one repeats, at the event where they diverge."""

from __future__ import annotations

from rsltrace.diff.alignment.rows import first_difference
from rsltrace.diff.facts.remarks import Repeats
from rsltrace.diff.result import Reproduction
from rsltrace.trace.native import refuse_native
from rsltrace.trace.reader import Trace


def reproduction(a: Trace, b: Trace, again: Trace) -> Reproduction:
    """Return which of two runs ``again`` repeats up to and including the event where they diverge.

    What comes after that is not looked at: ``again`` may have been recorded with ``--until``.

    :raises TraceError: if one of them is of a native run, which repeats nothing.
    """
    for trace in (a, b, again):
        refuse_native(trace, "it repeats no other run")
    place = first_difference(a, b)
    from_a, from_b = first_difference(a, again), first_difference(b, again)
    ended = again.ended_after if again.ended_after is not None else again.event_count
    if place is None:
        repeats = Repeats.A if from_a is None else Repeats.NEITHER
    elif from_a is None or from_a > place:
        repeats = Repeats.A
    elif from_b is None or from_b > place:
        repeats = Repeats.B
    else:
        too_short = from_a == from_b and ended <= from_a
        repeats = Repeats.TOO_SHORT if too_short else Repeats.NEITHER
    return Reproduction(repeats, again.name, place, from_a, from_b)
