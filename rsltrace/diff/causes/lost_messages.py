"""What became of a message that both runs sent and only one received."""

from __future__ import annotations

from rsltrace.diff.alignment.rows import Run, load_rows
from rsltrace.diff.result.events import EventView
from rsltrace.model.event import NO_EVENT, EventKind, OutputKind
from rsltrace.model.printable import printable

GONE = "nothing more reaches it"
OTHER_QOS = "its QoS is another one"
_LOOKED_AT_MAX = 1000


def lost_message(run_a: Run, run_b: Run, a: EventView | None, b: EventView | None) -> str:
    """Say that a queue overflowed, that a subscription is gone or has another QoS; "" where that
    is not so.

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
    if changed := _changed_qos(run_a, run_b, number):
        return f"{OTHER_QOS}: {changed}"
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


def _changed_qos(run_a: Run, run_b: Run, number: int) -> str:
    """Say which policies of a subscription differ but for its depth, which shows in another way."""
    a, b = _qos(run_a, number), _qos(run_b, number)
    differing = [name for name in a if name != "depth" and name in b and a[name] != b[name]]
    return ", ".join(f"{printable(n)} {_word(a[n])} in a, {_word(b[n])} in b" for n in differing)


def _word(value: object) -> str:
    return printable(str(value))


def _depth(run: Run, number: int) -> int | None:
    depth = _qos(run, number).get("depth")
    return depth if isinstance(depth, int) else None


def _qos(run: Run, number: int) -> dict[str, object]:
    table = run.matching.numbers_b if run.of_b else run.matching.numbers_a
    ids = (table == number).nonzero()[0]
    qos = run.trace.entities[int(ids[0])].detail.get("qos") if len(ids) else None
    return qos if isinstance(qos, dict) else {}
