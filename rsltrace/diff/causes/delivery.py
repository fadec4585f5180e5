"""Why an event happened in one run only, or at another time: messages that did not arrive, calls
that waited, sleeps, periods of timers, messages of a bag that changed places.

In the trace a wait is two events of its entity; what it was for stands at the end.
"""

from __future__ import annotations

from rsltrace.diff.alignment.rows import BAG, Run, load_rows
from rsltrace.diff.facts.causes import (
    Loss,
    NothingArrives,
    OtherQos,
    QueueOverflowed,
    Slept,
    StillWaits,
)
from rsltrace.diff.facts.evidence import EventView
from rsltrace.model.endless_wait import EndlessWait, waits_of
from rsltrace.model.event import NO_EVENT, EventFlag, EventKind, OutputKind

_LOOKED_AT_MAX = 1000


# -- messages that both runs sent and only one received ------------------------------------------


def lost_message(run_a: Run, run_b: Run, a: EventView | None, b: EventView | None) -> Loss | None:
    """Say that a queue overflowed, that a subscription is gone or has another QoS; None where that
    is not so.

    ``a`` or ``b`` is the event of the run that received the message, the other is None.
    """
    view = a or b
    if view is None or (a and b) or view.kind is not EventKind.SUBSCRIPTION:
        return None
    if view.cause_event == NO_EVENT:
        return None
    has_not, name = (run_b, "b") if a is not None else (run_a, "a")
    has = run_a if a is not None else run_b
    number = has_not.matching.by_key[view.entity]
    if changed := _changed_qos(run_a, run_b, number):
        return OtherQos(changed)
    later = _received_after(has_not, number, view.cause_event, view.cause_output)
    if later is None:
        more = _received_after(has, number, view.cause_event, view.cause_output)
        return NothingArrives(name) if more is not None else None
    depth = _depth(has_not, number)
    sent = _sent_between(has_not, view, later)
    if depth is not None and sent >= depth:
        return QueueOverflowed(depth, name)
    return None


def _received_after(
    run: Run, number: int, cause_event: int, cause_output: int
) -> tuple[int, int, int] | None:
    """Return the next event of a subscription after a message was sent that is of a later one:
    its index, and which output of which event it received."""
    rows = load_rows(run, cause_event, cause_event + _LOOKED_AT_MAX)
    for place, other in enumerate(rows.number):
        if other != number or rows.kind[place] != EventKind.SUBSCRIPTION:
            continue
        cause = rows.cause[place], rows.cause_output[place]
        if cause[0] != NO_EVENT and cause > (cause_event, cause_output):
            return rows.first + place, *cause
    return None


def _sent_between(run: Run, view: EventView, later: tuple[int, int, int]) -> int:
    """Return how many messages of the topic were sent after one, until the next was received."""
    index, cause_event, _ = later
    last = max(cause_event, min(index, cause_event + _LOOKED_AT_MAX))
    rows = load_rows(run, view.cause_event, last + 1)
    keys = run.matching.keys
    count = 0
    for place in range(len(rows)):
        for nth, (kind, number, _, _) in enumerate(rows.outputs(rows.first + place)):
            if kind != OutputKind.MESSAGE or keys[number].name != view.entity.name:
                continue
            count += (rows.first + place, nth) > (view.cause_event, view.cause_output)
    return count


def _changed_qos(run_a: Run, run_b: Run, number: int) -> tuple[tuple[str, str, str], ...]:
    """Return which policies of a subscription differ but for its depth, which shows in another
    way."""
    a, b = _qos(run_a, number), _qos(run_b, number)
    differing = [name for name in a if name != "depth" and name in b and a[name] != b[name]]
    return tuple((name, str(a[name]), str(b[name])) for name in differing)


def _depth(run: Run, number: int) -> int | None:
    depth = _qos(run, number).get("depth")
    return depth if isinstance(depth, int) else None


def _qos(run: Run, number: int) -> dict[str, object]:
    qos = _detail(run, number).get("qos")
    return qos if isinstance(qos, dict) else {}


def _detail(run: Run, number: int) -> dict[str, object]:
    """Return what the trace says of an entity, nothing if the run has it not."""
    table = run.matching.numbers_b if run.of_b else run.matching.numbers_a
    ids = (table == number).nonzero()[0]
    return run.trace.entities[int(ids[0])].detail if len(ids) else {}


# -- calls that waited, callbacks that slept -----------------------------------------------------


def still_waits(run_a: Run, run_b: Run, a: EventView | None, b: EventView | None) -> Loss | None:
    """Say which call waited to the end of a run and kept an event from happening there that the
    other has; None if there is no such call."""
    view = a or b
    if view is None or (a and b):
        return None
    name, lacking, having = ("b", run_b, run_a) if a else ("a", run_a, run_b)
    elsewhere = {one.text for one in _waits(having)}
    number = lacking.matching.by_key[view.entity]
    table = lacking.matching.numbers_b if lacking.of_b else lacking.matching.numbers_a
    for wait in _waits(lacking):
        is_held = any(0 <= one < len(table) and table[one] == number for one in wait.held)
        if wait.since_ns <= view.stamp_ns and (is_held or wait.text not in elsewhere):
            return StillWaits(wait.text, wait.since_ns, name)
    return None


def _waits(run: Run) -> list[EndlessWait]:
    return waits_of(run.trace.result) if run.trace.complete else []


def slept(run_a: Run, run_b: Run, a: EventView | None, b: EventView | None) -> Slept | None:
    """Return how long two events of one callback slept, or the callback before them; None if it was
    as long in both, or if they did not."""
    if a is None or b is None or a.kind is not b.kind:
        return None
    in_a, in_b = _slept_ns(run_a, a), _slept_ns(run_b, b)
    return None if in_a == in_b else Slept(in_a, in_b)


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


# -- timers, and bags ----------------------------------------------------------------------------


def periods(
    run_a: Run, run_b: Run, a: EventView | None, b: EventView | None
) -> tuple[int, int] | None:
    """Return the periods of a timer in both runs (ns), if they differ."""
    view = a or b
    if view is None or view.kind is not EventKind.TIMER:
        return None
    number = run_a.matching.by_key[view.entity]
    one, other = (_detail(run, number).get("period_ns") for run in (run_a, run_b))
    if isinstance(one, int) and isinstance(other, int) and one != other:
        return one, other
    return None


def are_swapped(run_a: Run, run_b: Run, a: EventView | None, b: EventView | None) -> bool:
    """Whether b plays what a plays at the time of ``a``, and at that time what a plays then."""
    if a is None or b is None or a.kind is not EventKind.BAG or a.stamp_ns == b.stamp_ns:
        return False
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
    return bool(there_a & there_b)
