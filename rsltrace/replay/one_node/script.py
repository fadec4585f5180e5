"""The recorded events that matter to the node that is replayed, in order."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np

from rsltrace.errors import ReplayError, near_or_all
from rsltrace.job import Job
from rsltrace.replay.one_node.result import SENT, Column, RecordingColumns
from rsltrace.simulation.loop.recorded_input_loop import NEVER, RecordedStep
from rsltrace.trace.departures import Departures
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_EVENT, NO_SEQUENCE, EventFlag, EventKind, OutputKind

# The entry of the job that made the node runs, with all that came from the same construction: an
# entry may make several nodes, threads and timers. A trace says which event created each entity,
# and which event caused which.

_OF_ALL = (EventKind.CLOCK_JUMP,)


class ReplayedEntry:
    """The entry that made ``node``.

    ``entities`` are the recorded ids of all that it made, ``nodes`` the full names of its nodes.
    ``entries`` are the places (among hooks and nodes of the job) of what is constructed: the entry,
    and the hooks that made no node.
    """

    def __init__(
        self, columns: RecordingColumns, job: Job, node: str, ordinals: Sequence[int]
    ) -> None:
        self.columns = columns
        self._ordinals = ordinals
        """Which entry each construction of the trace was that of."""
        self._of_event: dict[int, int] = {}
        self.node = find_node(columns, node)
        if (columns.events["kind"] == EventKind.FAULT).any():
            raise ReplayError(
                "the job lets nodes crash, hang or restart (faults:), which one node alone cannot "
                "repeat: replay the whole run (without --node)"
            )
        made_by = self._entry_of_entity(self.node.id)
        hooks = int(job.hooks.before is not None)
        count = hooks + len(job.nodes) + int(job.hooks.after is not None)
        if made_by < 0 or made_by >= count:
            raise ReplayError(
                f"{self.node.name} was made by {_maker(made_by)}, not by an entry of the job: "
                "it has no code to run"
            )
        entries = {one: self._entry_of_entity(one) for one in columns.trace.entities if one}
        self.entities = frozenset(one for one, entry in entries.items() if entry == made_by)
        made = set(entries.values())
        hook_places = {0} if hooks else set()
        hook_places |= {count - 1} if job.hooks.after is not None else set()
        self.entries = tuple(sorted({made_by, *(hook_places - made)}))
        self.nodes = tuple(
            entity.name
            for entity in columns.trace.entities.values()
            if entity.kind is EntityKind.NODE and entity.id in self.entities
        )
        self._ids = np.array(sorted(self.entities), dtype=np.uint32)

    @property
    def others(self) -> tuple[str, ...]:
        return tuple(name for name in self.nodes if name != self.node.name)

    @cached_property
    def own_events(self) -> Column:
        """For each event, whether the replayed entry causes it itself."""
        events = self.columns.events
        own = np.isin(events["entity"], self._ids)
        for index in np.flatnonzero(events["entity"] == 0).tolist():
            own[index] = events["kind"][index] in _OF_ALL or (
                self._entry_of_event(index) in self.entries
            )
        found: Column = own
        return found

    def is_own(self, entities: Column) -> Column:
        found: Column = np.isin(entities, self._ids)
        return found

    def done_by_others(self) -> int:
        """Return how many outputs of the node were made in events of others."""
        outputs, entities = self.columns.outputs, self.columns.trace.entities
        ids = [one for one in self.entities if entities[one].node == self.node.id]
        sent = np.isin(outputs["entity"], ids) & np.isin(outputs["kind"], SENT)
        return int((~self.own_events[outputs["event"][sent]]).sum())

    def entry_of(self, place: int) -> int:
        """Return the job entry of the construction at ``place`` in the trace."""
        return self._ordinals[place] if place < len(self._ordinals) else place

    def _entry_of_entity(self, entity_id: int) -> int:
        entity = self.columns.trace.entities[entity_id]
        if entity.node not in (0, entity_id):
            entity_id = entity.node
        created = self.columns.created_in.get(entity_id)
        return -1 if created is None else self._entry_of_event(created)

    def _entry_of_event(self, index: int) -> int:
        path = []
        found = -1
        while True:
            if index in self._of_event:
                found = self._of_event[index]
                break
            path.append(index)
            self._of_event[index] = -1  # should it go round in a circle
            row = self.columns.events[index]
            kind, entity, cause = int(row["kind"]), int(row["entity"]), int(row["cause_event"])
            if kind == EventKind.CONSTRUCT:
                found = self.entry_of(self.columns.constructions.index(index))
                break
            if entity:
                owner = self.columns.trace.entity(entity).node or entity
                created = self.columns.created_in.get(owner)
                if created is None:
                    break
                index = created
            elif cause != NO_EVENT and cause < index:
                index = cause
            elif kind == EventKind.RESUME:
                found = self._only_suspended(index)
                break
            else:
                break
        self._of_event.update(dict.fromkeys(path, found))
        return found

    def _only_suspended(self, index: int) -> int:
        """Return the only entry whose constructor waited until event ``index``, else -1."""
        waiting = [
            place
            for place, event in enumerate(self.columns.constructions)
            if event < index
            and self.columns.events["entity"][event] == 0
            and self.columns.events["flags"][event] & EventFlag.SUSPENDED
        ]
        if len(waiting) != 1:
            return -1
        return self.entry_of(waiting[0])


def find_node(columns: RecordingColumns, name: str) -> Entity:
    """Return a node by name, with or without its leading slash.

    :raises ReplayError: the recording has none; the message names the nodes.
    """
    trace = columns.trace
    nodes = [one for one in trace.entities.values() if one.kind is EntityKind.NODE]
    wanted = name if name.startswith("/") else f"/{name}"
    for node in nodes:
        if node.name == wanted:
            return node
    hint = near_or_all(wanted, (node.name for node in nodes))
    raise ReplayError(f"{trace.name} has no node {wanted}{hint}")


def _maker(entry: int) -> str:
    return "the driver of the simulation or another node" if entry < 0 else "a bag"


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

    def __init__(self, columns: RecordingColumns, unit: ReplayedEntry, perform: Performer) -> None:
        self._columns = columns
        self._perform = perform
        self.end_ns = columns.trace.end_ns
        self._own = unit.own_events
        self._others = ~unit.is_own(columns.outputs["entity"])
        self._waiting: deque[RecordedStep] = deque()
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
        self._late_ns = Departures().read(0, columns.events, columns.outputs)

    @cached_property
    def _events_of(self) -> dict[int, deque[int]]:
        found: dict[int, deque[int]] = {}
        own = np.flatnonzero(self._own)
        for index, entity in zip(
            own.tolist(), self._columns.events["entity"][own].tolist(), strict=True
        ):
            found.setdefault(entity, deque()).append(index)
        return found

    @property
    def next(self) -> RecordedStep | None:
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
        return self._entities.get(entity, -1)

    def following(self, entity: int) -> int:
        first = self.next
        events = self._events_of.get(entity)
        if first is None or not events:
            return NEVER
        while events and events[0] < first.index:
            events.popleft()
        return events[0] if events else NEVER

    def present(self, entity: int) -> int:
        """Return the entity of this run for a recorded one, or -1."""
        return self._present.get(entity, -1)

    def match_entity(self, entity: Entity, node: str) -> None:
        key = (node, entity.kind, entity.name)
        recorded = self._recorded.get((key, self._counts[key]))
        self._counts[key] += 1
        if recorded is not None:
            self._entities[entity.id] = recorded
            self._present[recorded] = entity.id

    def happened(self, kind: int, entity: int, now_ns: int) -> None:
        """Mark the step of an event as done: the next one, or a later one of this time."""
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
        """Do what other nodes did before an event."""
        while (step := self.next) is not None and step.index < event:
            step.done = True
            if step.perform is not None:
                step.perform()

    def _steps(self) -> Iterator[RecordedStep]:
        columns = self._columns
        outputs = columns.outputs
        kinds = np.isin(outputs["kind"], (*SENT, OutputKind.ENTITY))
        matters = self._own.copy()
        matters[outputs["event"][kinds & self._others]] = True
        for index in np.flatnonzero(matters[: columns.count]).tolist():
            row = columns.events[index]
            stamp_ns, kind, entity = int(row["stamp"]), int(row["kind"]), int(row["entity"])
            if self._own[index]:
                yield RecordedStep(index, stamp_ns, kind, entity)
            perform = self._performed(index)
            if perform is not None:
                yield RecordedStep(index, stamp_ns, kind, entity, perform)

    def _performed(self, index: int) -> Callable[[], None] | None:
        entities = self._columns.trace.entities
        created: list[Entity] = []
        sent: list[tuple[int, Any]] = []
        begin = int(self._columns.first_output[index])
        for place, row in enumerate(self._columns.outputs_of(index)):
            if not self._others[begin + place]:
                continue
            if row["kind"] == OutputKind.ENTITY:
                one = entities[int(row["entity"])]
                if one.kind in _ENDPOINTS:
                    created.append(one)
            elif row["kind"] in SENT:
                sent.append((place, row))
        if not (created or sent):
            return None
        return partial(self._perform, index, created, sent, self._late_ns.get(index, 0))


def _is(step: RecordedStep, kind: int, entity: int) -> bool:
    return step.perform is None and step.kind == kind and step.entity == entity


def _key(entity: Entity, entities: dict[int, Entity]) -> Key:
    return entities[entity.node].name, entity.kind, entity.name


def check_payloads(columns: RecordingColumns, unit: ReplayedEntry) -> None:
    """Check that the trace has the node's input messages.

    :raises ReplayError: saying which are missing, and how to record them.
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
