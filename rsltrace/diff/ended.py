"""Runs of which one is over where the other goes on, and did the same until then."""

from __future__ import annotations

from rsltrace.diff.classify import Judgement
from rsltrace.diff.engine import stop_reason
from rsltrace.diff.model import EventView, Root, Verdict
from rsltrace.diff.views import at
from rsltrace.model.event import EventKind
from rsltrace.trace.reader import Trace


def who_ended(a: Trace, b: Trace, start: int) -> Trace | None:
    """Return the run that ended at event ``start``, where the runs part; None if neither did.

    A run ends with the destruction of its nodes, which are events, or, when it was killed, just
    so. Two runs that both ended at the same time for the same reason did not part by ending.
    """
    over = _first_over(a, b, start)
    if over is None or (a.complete and b.complete and _ended_alike(a, b)):
        return None
    return over


def _first_over(a: Trace, b: Trace, start: int) -> Trace | None:
    for trace in (a, b):
        if start >= trace.event_count:
            return trace
    shut_a, shut_b = (trace.event(start).kind is EventKind.SHUTDOWN for trace in (a, b))
    if shut_a and shut_b:
        return a if a.end_ns < b.end_ns else b
    return a if shut_a else b if shut_b else None


def _ended_alike(a: Trace, b: Trace) -> bool:
    return a.end_ns == b.end_ns and stop_reason(a) == stop_reason(b)


def judge_ended(a: Trace, b: Trace, over: Trace, view_a: EventView | None) -> Judgement:
    """Put it in words. ``view_a`` is the event that only the other run has, or None."""
    verdict = Verdict.ENDED_EARLY if over is b else Verdict.RAN_LONGER
    name, other_name, other = ("b", "a", a) if over is b else ("a", "b", b)
    where = f" {at(over.end_ns)}" if over.event_count else ""
    sentence = (
        f"run {name} ended{where} ({stop_reason(over)}), {other_name} did the same until then and "
        f"went on {'to' if other.end_ns != over.end_ns else 'until'} {at(other.end_ns)[3:]} "
        f"({stop_reason(other)})"
    )
    if not over.complete:
        why = (
            f"the recording of {name} was cut off: its run was killed, is still going on, or the "
            "file is not whole"
        )
    else:
        why = (
            f"both do the same as long as they last; {name} was told to stop, or had no more to do"
        )
    a_view, b_view = (view_a, None) if over is b else (None, view_a)
    return Judgement(verdict, Root.UNKNOWN, sentence, why, a_view, b_view)
