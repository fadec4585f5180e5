"""A node's recorded state as lines, and what differs between two runs beside messages.

States are made of the changes up to an event, so one is put together only where somebody looks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rsltrace.diff.alignment.rows import Run as DiffRun
from rsltrace.diff.causes.state_differences import state_differences
from rsltrace.diff.result.divergence import (
    CallDifference,
    Divergence,
    StateDifference,
)
from rsltrace.diff.result.events import EventView
from rsltrace.errors import TraceError
from rsltrace.model.entity import EntityKind
from rsltrace.model.event import Event
from rsltrace.model.printable import printable, shortened
from rsltrace.trace.format import TOPIC_STATES
from rsltrace.trace.states import Leaf, state_after
from rsltrace_viewer.model.inspector.lines import Line, Openness, Role
from rsltrace_viewer.model.run import Run

_VALUE_MAX = 200
_ELEMENTS_SHOWN = 8


def state_lines(run: Run, event: Event, openness: Openness) -> Iterator[Line]:
    """Yield the attributes of the event's node after it; nothing if they were not recorded."""
    if not event.state_hash or not _has_states(run):
        return
    entity = run.entities[event.entity]
    node = entity.id if entity.kind is EntityKind.NODE else entity.node
    is_open = openness.is_open("state", False)
    title = f"of {run.node_name(event.entity)} after this event"
    yield Line(0, "state", title, Role.SECTION, "state", is_open)
    if not is_open:
        return
    try:
        state = state_after(run.trace, node, event.index)
    except TraceError as error:
        yield Line(1, "", printable(str(error)), Role.ERROR, "state.error")
        return
    for path, leaf in state.items():
        yield Line(1, printable(path), _shown(leaf), Role.FIELD, f"state.{path}")
    if not state:
        yield Line(1, "", "no attributes", Role.NOTE, "state.none")


def differing_state_lines(
    runs: tuple[DiffRun, DiffRun],
    views: tuple[EventView | None, EventView | None],
    divergence: Divergence | None,
    openness: Openness,
) -> Iterator[Line]:
    """Yield the attributes in which a node's states differ after an event of both runs.

    At the divergence they are known and shown; elsewhere they are looked for when opened.
    """
    a, b = views
    if (
        a is None
        or b is None
        or not (a.state_hash and b.state_hash)
        or a.state_hash == b.state_hash
    ):
        return
    is_open = openness.is_open("states", divergence is not None)
    yield Line(0, "≠ state", f"of {a.entity.node} after it", Role.SECTION, "states", is_open)
    if not is_open:
        return
    found: Sequence[StateDifference]
    found = divergence.state if divergence is not None else state_differences(*runs, a, b)
    for place, one in enumerate(found):
        path = f"states.{place}"
        yield Line(1, "", printable(one.path), Role.DIFFERENCE, path)
        for name, value in (("a", one.a), ("b", one.b)):
            text = "not there" if value is None else shortened(printable(value), _VALUE_MAX)
            yield Line(2, name, text, Role.FIELD, f"{path}.{name}")
    if not found:
        hint = "only hashes were recorded; guard: {state: record} in the job keeps the values"
        yield Line(1, "", hint, Role.NOTE, "states.none")


def differing_call_lines(calls: Sequence[CallDifference]) -> Iterator[Line]:
    """Yield the calls from outside that gave different answers, in the event or before it."""
    for place, call in enumerate(call for call in calls if call.a != call.b):
        path = f"calls.{place}"
        yield Line(0, "≠ call", f"{call.source}: {printable(call.call)}", Role.SECTION, path)
        yield Line(1, "at", printable(call.where), Role.NOTE, f"{path}.at")
        for name, value, event in (("a", call.a, call.event_a), ("b", call.b, call.event_b)):
            text = "not called" if value is None else shortened(printable(value), _VALUE_MAX)
            link = event if value is not None else None
            yield Line(
                1, name, text, Role.FIELD, f"{path}.{name}", link=link, other_run=name == "b"
            )


def _has_states(run: Run) -> bool:
    return any(channel.topic == TOPIC_STATES for channel in run.trace.channels.values())


def _shown(leaf: Leaf) -> str:
    if not isinstance(leaf, np.ndarray):
        return shortened(printable(leaf), _VALUE_MAX)
    first = ", ".join(repr(value.item()) for value in leaf.flat[:_ELEMENTS_SHOWN])
    more = ", …" if leaf.size > _ELEMENTS_SHOWN else ""
    shape = " x ".join(map(str, leaf.shape)) or "scalar"
    return f"{leaf.dtype} {shape}: [{first}{more}]"
