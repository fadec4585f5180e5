"""Why an event happened in one run only, or at another time: messages that did not arrive, calls
that waited, sleeps, periods of timers, messages of a bag that changed places.

In the trace a wait is two events of its entity; what it was for stands at the end.
"""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.diff.alignment.rows import BAG, ComparedTrace, load_rows, outputs_of
from rsltrace.diff.causes.event_views import entity_detail
from rsltrace.diff.facts.causes import (
    Loss,
    NoMoreMessages,
    QueueOverflow,
    SleepTimes,
    UnfinishedCall,
)
from rsltrace.diff.facts.evidence import (
    EntityChange,
    EntityChanges,
    EntityProperty,
    EventSummary,
    MessageDifference,
)
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind, OutputKind
from rsltrace.trace.model.finding import EndlessWait, decode_waits
from rsltrace.trace.words.entities import EntityKey

_LOOKED_AT_MAX = 1000
_PUBLISHER = EntityKind.PUBLISHER.label
_ENTITY = int(OutputKind.ENTITY)
_ENDS = {_PUBLISHER, EntityKind.SUBSCRIPTION.label}
_QOS_EVENT = EntityKind.QOS_EVENT.label
_OF_QOS = (EventKind.SUBSCRIPTION, EventKind.SERVICE, EventKind.CLIENT, EventKind.QOS_EVENT)
"""Events of endpoints."""


# -- messages that both runs sent and only one received ------------------------------------------


def lost_message(
    run_a: ComparedTrace, run_b: ComparedTrace, a: EventSummary | None, b: EventSummary | None
) -> Loss | None:
    """Say that a queue overflowed, that a subscription is gone or has another QoS; None where that
    is not so.

    ``a`` or ``b`` is the event of the run that received the message, the other is None.
    """
    view = a or b
    if view is None or (a and b):
        return None
    if view.kind in _OF_QOS and (changed := entity_changes(run_a, run_b, topics_of(view, ()))):
        return changed
    if view.kind is not EventKind.SUBSCRIPTION or view.cause_event == NO_EVENT:
        return None
    has_not, name = (run_b, "b") if a is not None else (run_a, "a")
    has = run_a if a is not None else run_b
    number = has_not.matching.by_key[view.entity]
    later = _received_after(has_not, number, view.cause_event, view.cause_output)
    if later is None:
        more = _received_after(has, number, view.cause_event, view.cause_output)
        return NoMoreMessages(name) if more is not None else None
    depth = _depth(has_not, number)
    sent = _sent_between(has_not, view, later)
    if depth is not None and sent >= depth:
        other = _depth(has, number)
        in_a, in_b = (depth, other) if name == "a" else (other, depth)
        return QueueOverflow(depth, name, (in_a, in_b))
    return None


def _received_after(
    run: ComparedTrace, number: int, cause_event: int, cause_output: int
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


def _sent_between(run: ComparedTrace, view: EventSummary, later: tuple[int, int, int]) -> int:
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


def _depth(run: ComparedTrace, number: int) -> int | None:
    depth = _qos(entity_detail(run, number)).get("depth")
    return depth if isinstance(depth, int) else None


def _qos(detail: dict[str, object]) -> dict[str, object]:
    qos = detail.get("qos")
    return qos if isinstance(qos, dict) else {}


# -- entities with other properties ---------------------------------------------------------------


def topics_of(
    view: EventSummary,
    messages: Sequence[MessageDifference],
    run: ComparedTrace | None = None,
) -> frozenset[str]:
    """Return the topics and services whose QoS an event, or what differs in it, can depend on; of
    an event of a ``run``, also when it happened: a missed deadline wakes a main."""
    met = [view.entity] if view.kind in _OF_QOS else []
    met += [m.entity for m in messages if m.kind in (OutputKind.ENTITY, OutputKind.DRAW)]
    if run is not None:
        made = (run.matching.keys[n] for k, n, *_ in outputs_of(run, view.index) if k == _ENTITY)
        met += [key for key in made if key.kind == _QOS_EVENT]
    # A QoS event goes by its topic and its status: "/scan incompatible".
    return frozenset(
        key.name.rpartition(" ")[0] if key.kind == _QOS_EVENT else key.name for key in met
    )


def entity_changes(
    run_a: ComparedTrace,
    run_b: ComparedTrace,
    topics: frozenset[str],
    nodes: frozenset[str] = frozenset(),
    *,
    with_depth: bool = False,
) -> EntityChanges | None:
    """Return which entities of both runs have another QoS, of some topics and services, or are in
    another callback group, of some nodes; None if there are none.

    Depths are only included ``with_depth``: they show as overflows.
    """
    alone = {*run_a.matching.only_a, *run_a.matching.only_b}
    known = {
        key: (entity_detail(run_a, number), entity_detail(run_b, number))
        for number, key in enumerate(run_a.matching.keys)
        if number not in alone and (key.name in topics or key.node in nodes)
    }
    found = []
    for key, details in known.items():
        qos_a, qos_b = (detail.get("qos") for detail in details)
        if key.name in topics and (values := _policies(qos_a, qos_b, with_depth=with_depth)):
            ends = [o for o in known if o.name == key.name and {o.kind, key.kind} == _ENDS]
            unmatched = {end: _unmatched((key, end), (details, known[end])) for end in ends}
            found.append(EntityChange(key, EntityProperty.QOS, values, *_in_one_run(unmatched)))
        group_a, group_b = (detail.get("group") for detail in details)
        if key.node in nodes and group_a != group_b:
            value = ("", str(group_a or "default"), str(group_b or "default"))
            shared = {
                other: (
                    group_a is not None and theirs[0].get("group") == group_a,
                    group_b is not None and theirs[1].get("group") == group_b,
                )
                for other, theirs in known.items()
                if other != key and other.node == key.node
            }
            found.append(EntityChange(key, EntityProperty.GROUP, (value,), *_in_one_run(shared)))
    return EntityChanges(tuple(found)) if found else None


def _policies(
    a: object, b: object, *, with_depth: bool
) -> tuple[tuple[str, str | int | None, str | int | None], ...]:
    if not isinstance(a, dict) or not isinstance(b, dict):
        return ()
    names = [name for name in {**a, **b} if a.get(name) != b.get(name)]
    return tuple((n, a.get(n), b.get(n)) for n in names if with_depth or n != "depth")


def _unmatched(
    keys: tuple[EntityKey, EntityKey], details: tuple[tuple[dict[str, object], ...], ...]
) -> tuple[bool, bool]:
    """Whether the QoS of two endpoints does not match in a, and in b."""
    from rsltrace.simulation.middleware.qos.policies import Qos, incompatible_policies

    offered, requested = details if keys[0].kind == _PUBLISHER else details[::-1]
    in_a, in_b = (
        bool(incompatible_policies(*(Qos.from_summary(_qos(detail)) for detail in ends)))
        for ends in zip(offered, requested, strict=True)
    )
    return in_a, in_b


def _in_one_run(related: dict[EntityKey, tuple[bool, bool]]) -> tuple[tuple[EntityKey, ...], str]:
    """Return the entities that are related in one run only, and which run that is."""
    for run, where in (("a", (True, False)), ("b", (False, True))):
        if found := tuple(key for key, runs in related.items() if runs == where):
            return found, run
    return (), ""


# -- calls that waited, callbacks that slept -----------------------------------------------------


def still_waits(
    run_a: ComparedTrace, run_b: ComparedTrace, a: EventSummary | None, b: EventSummary | None
) -> Loss | None:
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
            return UnfinishedCall(wait.text, lacking.trace.stamp(wait.since_ns), name)
    return None


def _waits(run: ComparedTrace) -> list[EndlessWait]:
    return decode_waits(run.trace.result) if run.trace.complete else []


def slept(
    run_a: ComparedTrace, run_b: ComparedTrace, a: EventSummary | None, b: EventSummary | None
) -> SleepTimes | None:
    """Return how long two events of one callback slept, or the callback before them; None if it was
    as long in both, or if they did not."""
    if a is None or b is None or a.kind is not b.kind:
        return None
    woke = a.kind is EventKind.RESUME and a.cause_event == b.cause_event == NO_EVENT
    back = woke and a.stamp_ns != b.stamp_ns
    in_a, in_b = _slept_ns(run_a, a, back=back), _slept_ns(run_b, b, back=back)
    return None if in_a == in_b else SleepTimes(in_a, in_b)


def _slept_ns(run: ComparedTrace, view: EventSummary, *, back: bool) -> int | None:
    """Return how long a callback slept after an event, or before one that resumed it (``back``)."""
    number = run.matching.by_key[view.entity]
    if back:
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
                woke = rows.kind[place] == EventKind.RESUME and rows.cause[place] == NO_EVENT
                until_ns = rows.stamp[place]  # the end of the run wakes whoever waits
                slept_ns = until_ns - view.stamp_ns if until_ns < run.trace.end_ns else 0
                return slept_ns or None if woke else None
    return None


# -- timers, and bags ----------------------------------------------------------------------------


def periods(
    run_a: ComparedTrace, run_b: ComparedTrace, a: EventSummary | None, b: EventSummary | None
) -> tuple[int, int] | None:
    """Return the periods of a timer in both runs (ns), if they differ."""
    view = a or b
    if view is None or view.kind is not EventKind.TIMER:
        return None
    number = run_a.matching.by_key[view.entity]
    one, other = (entity_detail(run, number).get("period_ns") for run in (run_a, run_b))
    if isinstance(one, int) and isinstance(other, int) and one != other:
        return one, other
    return None


def are_swapped(
    run_a: ComparedTrace, run_b: ComparedTrace, a: EventSummary | None, b: EventSummary | None
) -> bool:
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
