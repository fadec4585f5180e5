"""Runs of which one is over where the other goes on, and did the same until then."""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.diff.causes.classify import Judgement
from rsltrace.diff.causes.wording import because_of
from rsltrace.diff.result.events import EventView
from rsltrace.diff.result.settings import Setting
from rsltrace.diff.result.verdicts import ENDED_BY_EXCEPTION, Root, Verdict
from rsltrace.diff.traces.sides import stop_reason
from rsltrace.model.event import Event, EventFlag, EventKind
from rsltrace.model.printable import printable, shortened
from rsltrace.trace.format import REPLAY_DIVERGED
from rsltrace.trace.reader import Trace
from rsltrace.words.phrases import at_time, seconds_text

_LOOKED_AT_MAX = 100
_ERROR_MAX = 300
_WAITS_MAX = 160
NOTHING_LEFT = "nothing left to do"


def who_ended(a: Trace, b: Trace, start: int) -> Trace | None:
    """Return the run that ended at event ``start``, where the runs diverge; None if neither did.

    A run that ends has its mains and nodes end, which are events; when it was killed, its events
    just cease. Two runs that both ended at the same time did not diverge by ending, whatever their
    nodes did about it, and neither if one did more at that time and both ended for one reason.
    """
    for trace in (a, b):
        if not trace.complete and start >= trace.event_count:
            return trace
    if _end_alike(a, b):
        return None
    over_a, over_b = _is_over(a, b, start), _is_over(b, a, start)
    if over_a and over_b:
        return None if a.end_ns == b.end_ns else a if a.end_ns < b.end_ns else b
    return a if over_a else b if over_b else None


def _end_alike(a: Trace, b: Trace) -> bool:
    ends = [(trace.end_ns, stop_reason(trace), exit_code(trace)) for trace in (a, b)]
    return a.complete and b.complete and ends[0] == ends[1] and not exit_code(a)


def _stops(a: Trace, b: Trace, over: Trace, job: Sequence[Setting]) -> list[Setting]:
    """Return the stop conditions that differ, if it was they that ended a run."""
    if exit_code(over) or stop_reason(a) == stop_reason(b) == NOTHING_LEFT:
        return []
    return [setting for setting in job if setting.key.partition(".")[0] == "stop"]


def _why_ended(over: Trace, name: str, job: Sequence[Setting]) -> str:
    how = error_text(over)
    if how:
        how = f"{name} failed (exit code {exit_code(over)}): {how}"
    elif exit_code(over):
        how = f"{name} ended with exit code {exit_code(over)} ({stop_reason(over)})"
    elif had_nothing_left(over):
        how = f"{name} had nothing left to do"
    else:
        how = f"{name} ended because of this: {stop_reason(over)}"
    others = [s for s in job if s.key.partition(".")[0] not in ("stop", "record", "livelock_limit")]
    because = because_of(others)
    return f"both do the same until then; {how}{f'; {because}' if because else ''}"


def had_nothing_left(trace: Trace) -> bool:
    """Whether a run ended since no timer, wait or message was left in it."""
    return trace.complete and not exit_code(trace) and stop_reason(trace) == NOTHING_LEFT


def _waits(trace: Trace) -> str:
    """Return who waits for what in a run that ended in a deadlock, "" for any other."""
    if not exit_code(trace) or stop_reason(trace) != NOTHING_LEFT:
        return ""
    return error_text(trace).partition(": ")[2]


def exit_code(trace: Trace) -> int:
    """Return how a run ended, 0 if it is not known."""
    text = trace.result.get("exit_code", "0") if trace.complete else "0"
    return int(text) if text.isdecimal() else 0


def error_text(trace: Trace) -> str:
    """Return why a run failed, in one line; "" if it did not, or where the trace does not say."""
    text = trace.result.get("error", "") if trace.complete else ""
    return shortened(printable(" ".join(text.split())), _ERROR_MAX)


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


def failure_text(a: Trace, b: Trace) -> str:
    """Say how the one run failed that did, "" if both did or none."""
    if bool(exit_code(a)) == bool(exit_code(b)):
        return ""
    name, trace = ("a", a) if exit_code(a) else ("b", b)
    if stop_reason(trace) == REPLAY_DIVERGED:
        return ""
    why = error_text(trace) or stop_reason(trace)
    verb = "failed" if error_text(trace) or _failed(trace) is not None else "ended"
    return f"{name} then {verb} (exit code {exit_code(trace)}): {why}"


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


def _is_over(trace: Trace, other: Trace, start: int) -> bool:
    """Whether a run had ended before its event ``start``: not if it lasted until after that of the
    other, without an event."""
    if (
        not exit_code(trace)
        and start < other.event_count
        and other.event(start).stamp_ns < trace.end_ns
    ):
        return False
    if trace.ended_after is not None:
        return start >= trace.ended_after
    # A trace of an earlier version: one of class nodes ends with their destruction.
    return start >= trace.event_count or trace.event(start).kind is EventKind.SHUTDOWN


def judge_end(
    a: Trace,
    b: Trace,
    over: Trace,
    view_a: EventView | None,
    job: Sequence[Setting],
    alone: Judgement | None = None,
) -> Judgement:
    """Put it in words. ``view_a`` is the event that only the other run has, or None; ``job`` is
    what differs in the jobs; ``alone`` says why that event is missing in a run that had nothing
    left to do."""
    verdict = Verdict.ENDED_EARLY if over is b else Verdict.RAN_LONGER
    name, other_name, other = ("b", "a", a) if over is b else ("a", "b", b)
    where = f" {at_time(over.end_ns)}" if over.event_count else ""
    how = f"ended{where} ({stop_reason(over)})"
    if waits := _waits(over):
        how = f"got stuck{where} ({shortened(waits, _WAITS_MAX)})"
    sentence = (
        f"run {name} {how}, {other_name} did the same until then and "
        f"went on {'to' if other.end_ns != over.end_ns else 'until'} "
        f"{seconds_text(other.end_ns)} s ({stop_reason(other)})"
    )
    root, told = Root.UNKNOWN, []
    if not over.complete:
        why = (
            f"the recording of {name} was cut off: its run was killed, is still going on, or the "
            "file is not whole"
        )
    elif told := _stops(a, b, over, job):
        root = Root.JOB
        differs = "; ".join(f"{s.key}: {s.a or '-'} in a, {s.b or '-'} in b" for s in told)
        why = f"both do the same as long as they last, and their jobs differ in {differs}"
    elif alone is not None:
        told = list(alone.settings)
        why = f"{name} had nothing left to do: {alone.sentence}; {alone.root_sentence}"
    else:
        why = _why_ended(over, name, job)
    a_view, b_view = (view_a, None) if over is b else (None, view_a)
    return Judgement(verdict, root, sentence, why, a_view, b_view, tuple(told))
