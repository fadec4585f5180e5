"""The diff of two traces: find where they diverge, align what follows, say why.

    first difference -> entities matched -> blocks aligned -> roots and consequences -> Diff

Nothing is read of two identical runs but the ends of their files, and of others only what lies
around the divergence, unless ``everything`` is set.
"""

from __future__ import annotations

from rsltrace.diff.alignment.divergence import first_difference
from rsltrace.diff.facts.causes import Verdict
from rsltrace.diff.facts.remarks import DifferentEnd, Identical, Repeats
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import Diff, Reproduction, side
from rsltrace.trace.native import is_native, refuse_native
from rsltrace.trace.reader import Trace

# Which of two diverging runs a third one repeats, at the event where they diverge.


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


def diff_traces(a: Trace, b: Trace, options: DiffOptions | None = None) -> Diff:
    """Compare two runs. ``a`` and ``b`` stay open; the result needs them no more.

    Raises TraceError where a part that has to be read is damaged.
    """
    options = options or DiffOptions()
    start = first_difference(a, b)
    if start is not None and (is_native(a) or is_native(b)):
        from rsltrace.diff.traces.native import compare_native

        return compare_native(a, b, options)
    if start is None and a.complete and b.complete and a.event_count:
        return _identical(a, b)
    # Most runs are compared in the hope that they are identical: those load no more than this.
    from rsltrace.diff.traces.ended_runs import agree_until_cut, of_different_jobs

    if not (a.event_count and b.event_count) and (found := of_different_jobs(a, b)) is not None:
        return found
    if any(not t.complete and start in (None, t.event_count) for t in (a, b)):
        return agree_until_cut(a, b, options)
    if start is None:
        return _identical(a, b)
    from rsltrace.diff.traces.comparison import compare

    return compare(a, b, start, options)


def _identical(a: Trace, b: Trace) -> Diff:
    events = a.event_count
    return Diff(
        a=side(a),
        b=side(b),
        verdict=Verdict.IDENTICAL,
        outcome=Identical(events, "" if is_native(a) else a.digest),
        agreeing=events,
        aligned_to=(events, events),
        bytes_read=a.bytes_read + b.bytes_read,
        remarks=tuple(
            DifferentEnd(what.replace("_", " "), a.result.get(what), b.result.get(what))
            for what in ("stop_reason", "exit_code")
            if a.result.get(what) != b.result.get(what)
        ),
    )
