"""A node's recorded state as lines.

States are made of the changes up to an event, so one is put together only where somebody looks.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rsltrace.errors import TraceError
from rsltrace.trace.format import TOPIC_STATES
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import Event
from rsltrace.trace.model.printable import printable, shortened
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


def _has_states(run: Run) -> bool:
    return any(channel.topic == TOPIC_STATES for channel in run.trace.channels.values())


def _shown(leaf: Leaf) -> str:
    if not isinstance(leaf, np.ndarray):
        return shortened(printable(leaf), _VALUE_MAX)
    first = ", ".join(repr(value.item()) for value in leaf.flat[:_ELEMENTS_SHOWN])
    more = ", …" if leaf.size > _ELEMENTS_SHOWN else ""
    shape = " x ".join(map(str, leaf.shape)) or "scalar"
    return f"{leaf.dtype} {shape}: [{first}{more}]"
