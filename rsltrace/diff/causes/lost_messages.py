"""What became of a message that both runs sent and only one received."""

from __future__ import annotations

from rsltrace.diff.alignment.rows import Run, load_rows
from rsltrace.diff.result.events import EventView
from rsltrace.model.event import NO_EVENT, EventKind, OutputKind

GONE = "nothing more reaches it"
_LOOKED_AT_MAX = 1000


def lost_message(run_a: Run, run_b: Run, a: EventView | None, b: EventView | None) -> str:
    """Say that a queue overflowed, or that a subscription is gone; "" where that is not so.

    ``a`` or ``b`` is the event of the run that received the message, the other is None.
    """
    view = a or b
    if view is None or (a and b) or view.kind is not EventKind.SUBSCRIPTION:
        return ""
    if view.cause_event == NO_EVENT:
        return ""
    has_not, name = (run_b, "b") if a is not None else (run_a, "a")
    has = run_a if a is not None else run_b
    number = has_not.matching.by_key[view.entity]
    later = _received_after(has_not, number, view.cause_event, view.cause_output)
    if later is None:
        more = _received_after(has, number, view.cause_event, view.cause_output)
        return f"{GONE} in {name}" if more is not None else ""
    depth = _depth(has_not, number)
    sent = _sent_between(has_not, view, later)
    if depth is not None and sent >= depth:
        return f"its queue of {depth} overflowed in {name}"
    return ""


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


def _depth(run: Run, number: int) -> int | None:
    table = run.matching.numbers_b if run.of_b else run.matching.numbers_a
    ids = (table == number).nonzero()[0]
    qos = run.trace.entities[int(ids[0])].detail.get("qos") if len(ids) else None
    depth = qos.get("depth") if isinstance(qos, dict) else None
    return depth if isinstance(depth, int) else None
