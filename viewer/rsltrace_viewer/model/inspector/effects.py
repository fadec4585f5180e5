"""What an event caused: found by looking ahead, since a trace links effects to causes only."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import OutputKind, is_second_copy
from rsltrace_viewer.model.query.conditions import Mask, find
from rsltrace_viewer.model.run import Run, Segment

_SEGMENTS_AHEAD = 32
"""How far to look: over a hundred thousand events. Delays of a run are shorter than that."""
_SEGMENTS_AHEAD_SILENT = 1
"""The same for events without outputs, which cause something only by what no output says."""


@dataclass(frozen=True, slots=True)
class Effects:
    """Events that an event caused, as far as one has looked: up to event ``searched``."""

    event: int
    found: tuple[int, ...] = ()
    searched: int = 0
    done: bool = False


@dataclass(frozen=True, slots=True)
class CausedBy:
    event: int

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        found: Mask = segment.events["cause_event"] == np.uint64(self.event)
        return found

    def can_be_in(self, run: Run, number: int) -> bool:
        """Effects come later, and not later than one looks."""
        row = run.segments[number]
        return int(row["first_event"]) + int(row["events"]) > self.event


def effects_of(run: Run, index: int) -> Iterator[Effects]:
    """Yield what is known of the effects of an event, step by step; the last one is ``done``."""
    try:
        most = _most(run, index)
    except TraceError:
        most = None
    if most == 0 or index + 1 >= run.count:
        yield Effects(index, (), run.count - 1, True)
        return
    found: list[int] = []
    first = run.segment_of(index)
    ahead = _SEGMENTS_AHEAD if run.row(index)["outputs"] else _SEGMENTS_AHEAD_SILENT
    last = min(first + ahead, len(run.segments)) - 1
    searched = index
    number = first
    for place in find(run, CausedBy(index), index, 1):
        if place is None:
            searched = _end(run, number)
            number += 1
        else:
            found.append(place)
            number = max(number, run.segment_of(place))
            searched = place
        if (most is not None and len(found) >= most) or number > last:
            break
        yield Effects(index, tuple(found), searched)
    else:
        searched = run.count - 1
    yield Effects(index, tuple(found), searched, True)


def _end(run: Run, number: int) -> int:
    row = run.segments[min(number, len(run.segments) - 1)]
    return int(row["first_event"]) + int(row["events"]) - 1


def _most(run: Run, index: int) -> int | None:
    """Return how many effects there can be at most; None if the outputs do not tell.

    A message goes to each subscription of its topic, a request to one service, and so on. Tasks,
    timers and guard conditions cause events that no output announces.
    """
    total = 0
    for output in run.outputs(index):
        if output.kind is OutputKind.MESSAGE:
            entity = run.entities.get(output.entity)
            if entity is None:
                return None
            total += _receivers(run, entity.name)
        elif output.kind in (OutputKind.REQUEST, OutputKind.RESPONSE):
            total += 1
        elif output.kind is OutputKind.DRAW:
            total += is_second_copy(output.hash)
        elif output.kind in (OutputKind.TASK, OutputKind.TIMER, OutputKind.ENTITY):
            return None
    return total if run.row(index)["outputs"] else None


def _receivers(run: Run, topic: str) -> int:
    return sum(
        1 for e in run.entities.values() if e.name == topic and e.kind is EntityKind.SUBSCRIPTION
    )
