"""What runs when one node of a recording runs: the entry of the job that made it, and nothing else.

An entry may make several nodes (a ``main``, a function that returns a list), and its code has
threads and timers; all that came from the same construction belongs together. A trace says which
event created each entity, and which event caused which.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from rsltrace.errors import ReplayError, did_you_mean
from rsltrace.job import Job
from rsltrace.replay.one_node.result import SENT, Column, Columns
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind

_OF_ALL = (EventKind.CLOCK_JUMP,)


class Unit:
    """The entry that made ``node``.

    ``entities`` are the recorded ids of all that it made, ``nodes`` the full names of its nodes.
    ``entries`` are the places (among hooks and nodes of the job) of what is constructed: the entry,
    and the hooks that made no node.
    """

    def __init__(self, columns: Columns, job: Job, node: str, ordinals: Sequence[int]) -> None:
        self.columns = columns
        self._ordinals = ordinals
        """Which entry each construction of the trace was that of."""
        self._of_event: dict[int, int] = {}
        self.node = find_node(columns, node)
        if (columns.events["kind"] == EventKind.FAULT).any():
            raise ReplayError(
                "in this run the job lets nodes crash, hang or start again (faults:), which is not "
                "to be had for one node alone: replay the whole run (without --node)"
            )
        made_by = self._entry_of_entity(self.node.id)
        hooks = int(job.hooks.before is not None)
        count = hooks + len(job.nodes) + int(job.hooks.after is not None)
        if made_by < 0 or made_by >= count:
            raise ReplayError(
                f"{self.node.name} was made by {_maker(made_by)}, not by an entry of the job: "
                "there is no code of it to run"
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
        """The nodes that run with it, because the same entry makes them."""
        return tuple(name for name in self.nodes if name != self.node.name)

    @cached_property
    def own_events(self) -> Column:
        """For each event, whether it happens by itself when the unit runs."""
        events = self.columns.events
        own = np.isin(events["entity"], self._ids)
        for index in np.flatnonzero(events["entity"] == 0).tolist():
            own[index] = events["kind"][index] in _OF_ALL or (
                self._entry_of_event(index) in self.entries
            )
        found: Column = own
        return found

    def is_own(self, entities: Column) -> Column:
        """Return which of some entities are the unit's."""
        found: Column = np.isin(entities, self._ids)
        return found

    def done_by_others(self) -> int:
        """Return how many outputs of the node came about in events that are not the unit's."""
        outputs, entities = self.columns.outputs, self.columns.trace.entities
        ids = [one for one in self.entities if entities[one].node == self.node.id]
        sent = np.isin(outputs["entity"], ids) & np.isin(outputs["kind"], SENT)
        return int((~self.own_events[outputs["event"][sent]]).sum())

    def entry_of(self, place: int) -> int:
        """Return which entry the construction at ``place`` among those of the trace was that of."""
        return self._ordinals[place] if place < len(self._ordinals) else place

    # -- who made what ---------------------------------------------------------------------------

    def _entry_of_entity(self, entity_id: int) -> int:
        """Return the entry that made an entity, -1 if none did."""
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
        """Return the entry whose constructor has waited until event ``index``, if it is the only
        one that could have."""
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


def find_node(columns: Columns, name: str) -> Entity:
    """Return the node of a name, with or without the slash before it.

    :raises ReplayError: if the recording has none; it names those that there are.
    """
    trace = columns.trace
    nodes = [one for one in trace.entities.values() if one.kind is EntityKind.NODE]
    wanted = name if name.startswith("/") else f"/{name}"
    for node in nodes:
        if node.name == wanted:
            return node
    names = list(dict.fromkeys(node.name for node in nodes))
    hint = did_you_mean(wanted, names, f"its nodes are {', '.join(names)}")
    raise ReplayError(f"{trace.name} has no node {wanted}: {hint}")


def _maker(entry: int) -> str:
    return "whoever drove the simulation, or another node's code" if entry < 0 else "a bag"
