"""How long a callback slept, and which one waited until the end of a run.

In the trace a wait is two events of its entity; what it was for stands at the end.
"""

from __future__ import annotations

from rsltrace.diff.alignment.rows import Run, load_rows
from rsltrace.diff.result.events import EventView
from rsltrace.model.endless_wait import EndlessWait, waits_of
from rsltrace.model.event import NO_EVENT, EventFlag, EventKind
from rsltrace.model.printable import shortened
from rsltrace.model.stamp import format_duration
from rsltrace.words.phrases import seconds_text

_LOOKED_AT_MAX = 1000
_WAITS_MAX = 160


def still_waits(run_a: Run, run_b: Run, a: EventView | None, b: EventView | None) -> str:
    """Say which call waited to the end of a run and kept an event from happening there that the
    other has; "" if there is no such call."""
    view = a or b
    if view is None or (a and b):
        return ""
    name, lacking, having = ("b", run_b, run_a) if a else ("a", run_a, run_b)
    elsewhere = {one.text for one in _waits(having)}
    number = lacking.matching.by_key[view.entity]
    table = lacking.matching.numbers_b if lacking.of_b else lacking.matching.numbers_a
    for wait in _waits(lacking):
        is_held = any(0 <= one < len(table) and table[one] == number for one in wait.held)
        if wait.since_ns <= view.stamp_ns and (is_held or wait.text not in elsewhere):
            since = seconds_text(wait.since_ns)
            return f"{shortened(wait.text, _WAITS_MAX)}, from {since} s to the end of {name}"
    return ""


def _waits(run: Run) -> list[EndlessWait]:
    return waits_of(run.trace.result) if run.trace.complete else []


def slept_text(run_a: Run, run_b: Run, a: EventView | None, b: EventView | None) -> str:
    """Return ``slept 7 ms in b and not in a`` of two events of one callback, or of what followed
    its sleep; "" if it slept as long in both, or did not."""
    if a is None or b is None or a.kind is not b.kind:
        return ""
    slept = _slept_ns(run_a, a), _slept_ns(run_b, b)
    if slept[0] == slept[1]:
        return ""
    in_a, in_b = (None if ns is None else format_duration(ns) for ns in slept)
    if in_a and in_b:
        return f"slept {in_a} in a and {in_b} in b"
    return f"slept {in_a} in a and not in b" if in_a else f"slept {in_b} in b and not in a"


def _slept_ns(run: Run, view: EventView) -> int | None:
    """Return how long a callback slept after an event, or before one with which it went on."""
    number = run.matching.by_key[view.entity]
    if view.kind is EventKind.RESUME and view.cause_event == NO_EVENT:
        rows = load_rows(run, max(view.index - _LOOKED_AT_MAX, 0), view.index)
        for place in reversed(range(len(rows))):
            if rows.number[place] == number:
                suspended = rows.flags[place] & EventFlag.SUSPENDED
                slept_ns = view.stamp_ns - rows.stamp[place]
                return slept_ns or None if suspended else None
    elif view.flags & EventFlag.SUSPENDED:
        rows = load_rows(run, view.index + 1, view.index + 1 + _LOOKED_AT_MAX)
        for place in range(len(rows)):
            if rows.number[place] == number:
                slept = rows.kind[place] == EventKind.RESUME and rows.cause[place] == NO_EVENT
                slept_ns = rows.stamp[place] - view.stamp_ns
                return slept_ns or None if slept else None
    return None
