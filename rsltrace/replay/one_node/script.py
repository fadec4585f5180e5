"""The script of a fed run: what of a recording the nodes that run notice, in its order."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from typing import Any

import numpy as np

from rsltrace.errors import ReplayError
from rsltrace.replay.one_node.result import SENT, Columns
from rsltrace.replay.one_node.unit import Unit
from rsltrace.simulation.loop.fed import NEVER, Step
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_SEQUENCE, Draw, EventKind, OutputKind, duration_of

_ENDPOINTS = (
    EntityKind.NODE,
    EntityKind.PUBLISHER,
    EntityKind.SUBSCRIPTION,
    EntityKind.CLIENT,
    EntityKind.SERVICE,
)
Key = tuple[str, EntityKind, str]
Performer = Callable[[int, list[Entity], list[tuple[int, Any]], int], None]


class RecordedScript:
    """The steps of a recording: what others did, and the events of the unit.

    ``perform(event, created, sent, busy_ns)`` does what others did in an event: ``sent`` are
    pairs of an output's place and its row.
    """

    def __init__(self, columns: Columns, unit: Unit, perform: Performer) -> None:
        self._columns = columns
        self._perform = perform
        self.end_ns = columns.trace.end_ns
        self._own = unit.own_events
        self._others = ~unit.is_own(columns.outputs["entity"])
        self._waiting: deque[Step] = deque()
        self._following = self._steps()
        names = columns.trace.entities
        self._recorded: dict[tuple[Key, int], int] = {}
        counts: Counter[Key] = Counter()
        for entity in names.values():
            if entity.id in unit.entities:
                key = _key(entity, names)
                self._recorded[key, counts[key]] = entity.id
                counts[key] += 1
        self._counts: Counter[Key] = Counter()
        self._entities = {0: 0}
        self._present: dict[int, int] = {}
        self._drawn: dict[int, int] = {}

    @cached_property
    def _events_of(self) -> dict[int, deque[int]]:
        """The events of each entity of the unit."""
        found: dict[int, deque[int]] = {}
        own = np.flatnonzero(self._own)
        for index, entity in zip(
            own.tolist(), self._columns.events["entity"][own].tolist(), strict=True
        ):
            found.setdefault(entity, deque()).append(index)
        return found

    # -- for the loop ----------------------------------------------------------------------------

    @property
    def next(self) -> Step | None:
        """The first step that is not done, None after the last."""
        waiting = self._waiting
        while waiting and waiting[0].done:
            waiting.popleft()
        if waiting:
            return waiting[0]
        step_or_none = next(self._following, None)
        if step_or_none is not None:
            waiting.append(step_or_none)
        return step_or_none

    def entity(self, entity: int) -> int:
        """Return the recorded entity that one of the run stands for, -1 if none."""
        return self._entities.get(entity, -1)

    def following(self, entity: int) -> int:
        """Return the index of the next event of a recorded entity, NEVER if none is to come."""
        first = self.next
        events = self._events_of.get(entity)
        if first is None or not events:
            return NEVER
        while events and events[0] < first.index:
            events.popleft()
        return events[0] if events else NEVER

    # -- for the run -----------------------------------------------------------------------------

    def present(self, entity: int) -> int:
        """Return the entity of the run that stands for a recorded one, -1 if there is none."""
        return self._present.get(entity, -1)

    def met(self, entity: Entity, node: str) -> None:
        """Take note of an entity that the run has made."""
        key = (node, entity.kind, entity.name)
        recorded = self._recorded.get((key, self._counts[key]))
        self._counts[key] += 1
        if recorded is not None:
            self._entities[entity.id] = recorded
            self._present[recorded] = entity.id

    def happened(self, kind: int, entity: int, now_ns: int) -> None:
        """Take note of an event of the unit: it is the next one, or a later one of this time."""
        recorded = self.entity(entity)
        first = self.next
        if first is None:
            return
        if _is(first, kind, recorded):
            first.done = True
            return
        for step in self._waiting:
            if not step.done and step.stamp_ns <= now_ns and _is(step, kind, recorded):
                step.done = True
                return
        while self._waiting[-1].stamp_ns <= now_ns:
            step_or_none = next(self._following, None)
            if step_or_none is None:
                return
            self._waiting.append(step_or_none)
            if step_or_none.stamp_ns <= now_ns and _is(step_or_none, kind, recorded):
                step_or_none.done = True
                return

    def perform_until(self, event: int) -> None:
        """Do what others did before an event."""
        while (step := self.next) is not None and step.index < event:
            step.done = True
            if step.perform is not None:
                step.perform()

    def _steps(self) -> Iterator[Step]:
        columns = self._columns
        outputs = columns.outputs
        kinds = np.isin(outputs["kind"], (*SENT, OutputKind.ENTITY))
        matters = self._own.copy()
        matters[outputs["event"][kinds & self._others]] = True
        draws = (outputs["kind"] == OutputKind.DRAW) & (outputs["hash"] >> 56 == Draw.EXECUTION)
        matters[outputs["event"][draws]] = True
        for index in np.flatnonzero(matters[: columns.count]).tolist():
            row = columns.events[index]
            stamp_ns, kind, entity = int(row["stamp"]), int(row["kind"]), int(row["entity"])
            if self._own[index]:
                yield Step(index, stamp_ns, kind, entity)
            perform = self._performed(index, kind, entity)
            if perform is not None:
                yield Step(index, stamp_ns, kind, entity, perform)

    def _performed(self, index: int, kind: int, entity: int) -> Callable[[], None] | None:
        entities = self._columns.trace.entities
        created: list[Entity] = []
        sent: list[tuple[int, Any]] = []
        begin = int(self._columns.first_output[index])
        busy_ns = self._drawn.get(entity, 0) if kind == EventKind.RESUME else 0
        for place, row in enumerate(self._columns.outputs_of(index)):
            if row["kind"] == OutputKind.DRAW:
                drawn_ns = duration_of(int(row["hash"]), Draw.EXECUTION)
                if drawn_ns is not None:
                    busy_ns = self._drawn[entity] = drawn_ns
            elif not self._others[begin + place]:
                continue
            elif row["kind"] == OutputKind.ENTITY:
                one = entities[int(row["entity"])]
                if one.kind in _ENDPOINTS:
                    created.append(one)
            elif row["kind"] in SENT:
                sent.append((place, row))
        if not (created or sent):
            return None
        return partial(self._perform, index, created, sent, busy_ns)


def _is(step: Step, kind: int, entity: int) -> bool:
    return step.perform is None and step.kind == kind and step.entity == entity


def _key(entity: Entity, entities: dict[int, Entity]) -> Key:
    return entities[entity.node].name, entity.kind, entity.name


def check_payloads(columns: Columns, unit: Unit) -> None:
    """See that the trace has what the unit's nodes have got.

    :raises ReplayError: saying what it does not have, and how to record it.
    """
    entities = columns.trace.entities
    outputs = columns.outputs
    own = [entities[one] for one in unit.entities]
    topics = {one.name for one in own if one.kind is EntityKind.SUBSCRIPTION}
    services = {one.name for one in own if one.kind in (EntityKind.SERVICE, EntityKind.CLIENT)}
    lost = outputs[(outputs["sequence"] == NO_SEQUENCE) & ~unit.is_own(outputs["entity"])]
    lost = lost[np.isin(lost["kind"], SENT)]
    missing = set()
    for number in np.unique(lost["entity"]).tolist():
        entity = entities[number]
        if entity.name in (topics if entity.kind is EntityKind.PUBLISHER else services):
            missing.add(entity.name)
    if missing:
        names = sorted(missing)
        raise ReplayError(
            f"{columns.trace.name} does not hold what {unit.node.name} got on {', '.join(names)}: "
            "the job's record: leaves these messages out; record once more with them "
            "(record.payloads, record.topics and record.exclude say what is kept)"
        )
