"""Runs of which one is over where the other goes on, and did the same until then."""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.diff.causes.classify import Judgement
from rsltrace.diff.result.events import EventView
from rsltrace.diff.result.traces import Setting
from rsltrace.diff.result.verdicts import ENDED_BY_EXCEPTION, Root, Verdict
from rsltrace.diff.traces.sides import stop_reason
from rsltrace.model.event import Event, EventFlag, EventKind
from rsltrace.trace.reader import Trace
from rsltrace.words.phrases import at_time, seconds_text

_LOOKED_AT_MAX = 100


def who_ended(a: Trace, b: Trace, start: int) -> Trace | None:
    """Return the run that ended at event ``start``, where the runs diverge; None if neither did.

    A run that ends has its mains and nodes end, which are events; when it was killed, its events
    just cease. Two runs that both ended at the same time did not diverge by ending, whatever their
    nodes did about it.
    """
    for trace in (a, b):
        if not trace.complete and start >= trace.event_count:
            return trace
    over_a, over_b = _is_over(a, start), _is_over(b, start)
    if over_a and over_b:
        return None if a.end_ns == b.end_ns else a if a.end_ns < b.end_ns else b
    return a if over_a else b if over_b else None


def failures(a: Trace, b: Trace) -> list[str]:
    """Return a note for each run that an exception ended, if that did not happen in both."""
    if stop_reason(a) == stop_reason(b):
        return []
    return [
        f"{name} {ENDED_BY_EXCEPTION}: {stop_reason(trace)}, event {event.index}, "
        f"{seconds_text(event.stamp_ns)} s"
        for name, trace in (("a", a), ("b", b))
        if (event := _failed(trace)) is not None
    ]


def _failed(trace: Trace) -> Event | None:
    """Return the event whose exception ended a run: what follows it are the ends of its nodes."""
    if not trace.complete or trace.result.get("exit_code", "0") == "0":
        return None
    last = trace.ended_after or trace.event_count
    for index in range(last - 1, max(last - _LOOKED_AT_MAX, 0) - 1, -1):
        event = trace.event(index)
        if EventFlag.RAISED in event.flags:
            return event
    return None


def _is_over(trace: Trace, start: int) -> bool:
    """Whether a run had ended before its event ``start``."""
    if trace.ended_after is not None:
        return start >= trace.ended_after
    # A trace of an earlier version: one of class nodes ends with their destruction.
    return start >= trace.event_count or trace.event(start).kind is EventKind.SHUTDOWN


def judge_end(
    a: Trace, b: Trace, over: Trace, view_a: EventView | None, job: Sequence[Setting]
) -> Judgement:
    """Put it in words. ``view_a`` is the event that only the other run has, or None; ``job`` is
    what differs in the jobs."""
    verdict = Verdict.ENDED_EARLY if over is b else Verdict.RAN_LONGER
    name, other_name, other = ("b", "a", a) if over is b else ("a", "b", b)
    where = f" {at_time(over.end_ns)}" if over.event_count else ""
    sentence = (
        f"run {name} ended{where} ({stop_reason(over)}), {other_name} did the same until then and "
        f"went on {'to' if other.end_ns != over.end_ns else 'until'} "
        f"{seconds_text(other.end_ns)} s ({stop_reason(other)})"
    )
    root = Root.UNKNOWN
    if not over.complete:
        why = (
            f"the recording of {name} was cut off: its run was killed, is still going on, or the "
            "file is not whole"
        )
    elif told := [setting for setting in job if setting.key.partition(".")[0] == "stop"]:
        root = Root.JOB
        differs = "; ".join(f"{s.key}: {s.a or '-'} in a, {s.b or '-'} in b" for s in told)
        why = f"both do the same as long as they last, and their jobs differ in {differs}"
    else:
        why = (
            f"both do the same as long as they last; {name} was told to stop, or had no more to do"
        )
    a_view, b_view = (view_a, None) if over is b else (None, view_a)
    return Judgement(verdict, root, sentence, why, a_view, b_view)
