"""Runs of which one ends where the other continues."""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.diff.alignment.entity_matching import match_entities
from rsltrace.diff.causes.job_settings import job_settings
from rsltrace.diff.causes.relevance import entity_settings, environment_settings
from rsltrace.diff.facts.causes import (
    CauseFact,
    CauseKind,
    EarlierEnd,
    Judgement,
    NoEventsLeft,
    Root,
    RunEnd,
    Verdict,
)
from rsltrace.diff.facts.evidence import EventSummary, Setting
from rsltrace.diff.facts.remarks import DifferentJobs, EndedByException, EqualUntilTruncated, Remark
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import Diff, interruptions, side, stop_reason
from rsltrace.trace.format import REPLAY_DIVERGED
from rsltrace.trace.model.event import EventFlag, EventKind, EventRecord
from rsltrace.trace.model.texts import printable, shortened
from rsltrace.trace.reader import Trace

# Runs that agree until the recording of one of them is cut, or that have nothing to compare.


def agree_until_cut(a: Trace, b: Trace, options: DiffOptions) -> Diff:
    """Return the diff of two runs that agree as far as both recordings go."""
    events = min(a.event_count, b.event_count)
    cut = tuple(name for name, trace in (("a", a), ("b", b)) if not trace.complete)
    return Diff(
        a=side(a),
        b=side(b),
        verdict=Verdict.AGREE_UNTIL_TRUNCATED,
        outcome=EqualUntilTruncated(events, cut),
        agreeing=events,
        settings=(*job_settings(a, b), *environment_settings(a, b)),
        aligned_to=(events, events),
        bytes_read=a.bytes_read + b.bytes_read,
        remarks=tuple(interruptions(a, b)),
        allow_truncated=options.allow_truncated,
    )


def of_different_jobs(a: Trace, b: Trace) -> Diff | None:
    """Return the diff of runs of which one has no event, if their jobs or graphs differ."""
    settings = (*job_settings(a, b), *_different_graphs(a, b))
    if not settings:
        return None
    empty = tuple(name for name, trace in (("a", a), ("b", b)) if not trace.event_count)
    return Diff(
        a=side(a),
        b=side(b),
        verdict=Verdict.DIFFERENT_JOBS,
        outcome=DifferentJobs((a.job.get("name", ""), b.job.get("name", "")), empty),
        agreeing=0,
        settings=(*settings, *environment_settings(a, b)),
        bytes_read=a.bytes_read + b.bytes_read,
        remarks=tuple(interruptions(a, b)),
    )


def _different_graphs(a: Trace, b: Trace) -> tuple[Setting, ...]:
    """Return the entities that only one run has, unless it may be for being cut."""
    ids = a.entities.keys() & b.entities.keys()
    if a.complete and b.complete:
        ids = a.entities.keys() | b.entities.keys()
    if all(a.entities.get(i) == b.entities.get(i) for i in ids):
        return ()
    return entity_settings(match_entities(a, b))


_LOOKED_AT_MAX = 100
_ERROR_MAX = 300
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
    return [setting for setting in job if setting.part == "stop"]


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


def failures(a: Trace, b: Trace) -> list[Remark]:
    """Return a remark for each run that an exception ended, if that did not happen in both."""
    if stop_reason(a) == stop_reason(b):
        return []
    return [
        EndedByException(name, stop_reason(trace), event.index, trace.stamp(event.stamp_ns))
        for name, trace in (("a", a), ("b", b))
        if (event := _failed(trace)) is not None
    ]


def failure(a: Trace, b: Trace) -> RunEnd | None:
    """Return how the one run failed that did, None if both did or none."""
    if bool(exit_code(a)) == bool(exit_code(b)):
        return None
    name, trace = ("a", a) if exit_code(a) else ("b", b)
    return None if stop_reason(trace) == REPLAY_DIVERGED else _end_of(name, trace)


def _end_of(name: str, trace: Trace) -> RunEnd:
    return RunEnd(
        name,
        trace.stamp(trace.end_ns),
        stop_reason(trace),
        has_events=bool(trace.event_count),
        exit_code=exit_code(trace),
        error=error_text(trace),
        stuck=_waits(trace),
        nothing_left=had_nothing_left(trace),
        raised=_failed(trace) is not None,
    )


def _failed(trace: Trace) -> EventRecord | None:
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
    view_a: EventSummary | None,
    job: Sequence[Setting],
    alone: Judgement | None = None,
) -> Judgement:
    """Return the verdict. ``view_a`` is the event that only the other run has, or None; ``job`` is
    what differs in the jobs; ``alone`` says why that event is missing in a run that had nothing
    left to do."""
    verdict = Verdict.ENDED_EARLY if over is b else Verdict.RAN_LONGER
    name = "b" if over is b else "a"
    ends = _end_of("a", a), _end_of("b", b)
    what = EarlierEnd(*(ends[::-1] if over is b else ends))
    root = Root.UNKNOWN
    settings: tuple[Setting, ...] = ()
    why: CauseFact
    if not over.complete:
        why = CauseKind.CUT_OFF
    elif stops := _stops(a, b, over, job):
        root, why, settings = Root.JOB, CauseKind.STOPS_DIFFER, tuple(stops)
    elif alone is not None:
        why, settings = NoEventsLeft(name, alone), alone.settings
    else:
        why = CauseKind.ENDED
        others = (one for one in job if one.part not in ("stop", "record", "livelock_limit"))
        settings = tuple(others)
    in_a, in_b = (view_a, None) if over is b else (None, view_a)
    return Judgement(verdict, root, what, why, in_a, in_b, settings=settings)
