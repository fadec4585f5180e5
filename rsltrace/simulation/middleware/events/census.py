"""Who and what there has been in a run: every node, topic, service and timer.

A rule of a job that fits none of them does nothing, and nobody would notice.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from rsltrace.simulation.loop.recorded import THE_RUN, described
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder
from rsltrace.trace.model.entity import Entity, EntityKind

_ACTIONS = (EntityKind.ACTION_CLIENT, EntityKind.ACTION_SERVER)
_ACTION_TOPICS = ("feedback", "status")
_ACTION_SERVICES = ("send_goal", "cancel_goal", "get_result")
_SENDERS = (EntityKind.PUBLISHER, *_ACTIONS)
_RECEIVERS = (EntityKind.SUBSCRIPTION, *_ACTIONS)
_SERVICES = (EntityKind.CLIENT, EntityKind.SERVICE)


class Asker(NamedTuple):
    """A node that has asked what a name becomes; ``entry_key`` is that of the job's entry that made
    it, empty if none did."""

    entry_key: str
    name: str
    namespace: str


class Census(EventObserver):
    """The names there have been, each once, in the order of their coming."""

    order = ObserverOrder.CENSUS

    def __init__(self) -> None:
        self._names: dict[int, str] = {}
        self.nodes: dict[str, None] = {}
        self.services: dict[str, None] = {}
        self.publishers: dict[tuple[str, str], None] = {}
        """(node, topic)"""
        self.subscriptions: dict[tuple[str, str], None] = {}
        self.entities: dict[tuple[str, str], None] = {}
        """(node, name) of all that may have a callback: topic, service, a timer's callback."""
        self.asked: dict[Asker, dict[tuple[str, bool], None]] = {}
        """What each node has asked for before it was remapped: (full name, whether a service)."""
        self.described: dict[int, str] | None = None
        """Every entity as in ``described``, by its id, if somebody wants to know: a run may make
        a thread in each of a million callbacks."""

    def entity_created(self, entity: Entity) -> None:
        """Remember an entity; its node comes before it."""
        if entity.kind is EntityKind.NODE:
            self._names[entity.id] = entity.name
            self._describe(entity, entity.name)
            self.nodes[entity.name] = None
            return
        node = self._names.get(entity.node, "")
        self._describe(entity, node)
        self.entities[node, entity.name] = None
        if entity.kind in _SERVICES:
            self.services[entity.name] = None
        elif entity.kind in _ACTIONS:
            self.services.update({f"{entity.name}/_action/{s}": None for s in _ACTION_SERVICES})
        for kinds, topics in ((_SENDERS, self.publishers), (_RECEIVERS, self.subscriptions)):
            if entity.kind in _ACTIONS:
                topics.update({(node, f"{entity.name}/_action/{t}"): None for t in _ACTION_TOPICS})
            elif entity.kind in kinds:
                topics[node, entity.name] = None

    def describe_all(self) -> Callable[[int], str | None]:
        """Keep the names of all entities from now on; return the function that knows them."""
        self.described = {0: THE_RUN}
        return self.described.get

    def _describe(self, entity: Entity, node: str) -> None:
        if self.described is not None:
            self.described[entity.id] = described(entity, node)

    @property
    def topics(self) -> dict[str, None]:
        """Every topic that somebody publishes or subscribes."""
        return {topic: None for _, topic in (*self.publishers, *self.subscriptions)}
