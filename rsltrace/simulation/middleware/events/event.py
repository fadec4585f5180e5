"""The current event: whose code runs, what caused it, and how it will be recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from typing import Any, NamedTuple, Protocol

from rsltrace.compiled import EventFields
from rsltrace.errors import RunError
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.loop.loop import Dispatchable
from rsltrace.simulation.loop.recorded_order import THE_RUN, entity_text
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_EVENT
from rsltrace.trace.model.finding import EndlessWait, SuppressedException

_ACTIONS = (EntityKind.ACTION_CLIENT, EntityKind.ACTION_SERVER)
_ACTION_TOPICS = ("feedback", "status")
_ACTION_SERVICES = ("send_goal", "cancel_goal", "get_result")
_SENDERS = (EntityKind.PUBLISHER, *_ACTIONS)
_RECEIVERS = (EntityKind.SUBSCRIPTION, *_ACTIONS)
_SERVICES = (EntityKind.CLIENT, EntityKind.SERVICE)


class NameRequester(NamedTuple):
    """A node that resolved a name; ``entry_key`` is the key of its job entry, or ""."""

    entry_key: str
    name: str
    namespace: str


class NameRegistry(EventObserver):
    """The names of all nodes, topics, services and timers of a run, in order of creation."""

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
        self.asked: dict[NameRequester, dict[tuple[str, bool], None]] = {}
        """What each node has asked for before it was remapped: (full name, whether a service)."""
        self.described: dict[int, str] | None = None
        """Every entity as in ``entity_text``, by its id, if needed: a run may make a
        thread in each of a million callbacks."""

    def entity_created(self, entity: Entity) -> None:
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
        """Keep the names of all entities from now on; return the lookup function."""
        self.described = {0: THE_RUN}
        return self.described.get

    def _describe(self, entity: Entity, node: str) -> None:
        if self.described is not None:
            self.described[entity.id] = entity_text(entity, node)

    @property
    def topics(self) -> dict[str, None]:
        return {topic: None for _, topic in (*self.publishers, *self.subscriptions)}


@dataclass(slots=True)
class RunOutcome:
    """How a run has gone. ``ended_after`` is the number of events when it ended; later ones are its
    shutdown. ``waits`` are the calls that still waited then, ``suppressed`` the exceptions that
    rclpy suppressed. ``drops`` counts the drops of full
    queues by receiver, and by queue size of a publisher in an outage (else 0). ``unseen`` has the
    process of each topic whose messages did not leave it."""

    error: RunError | None = None
    notes: list[str] = field(default_factory=list)
    ended_after: int | None = None
    waits: list[EndlessWait] = field(default_factory=list)
    suppressed: list[SuppressedException] = field(default_factory=list)
    drops: dict[tuple[Any, int], int] = field(default_factory=dict)
    unseen: dict[str, str] = field(default_factory=dict)

    def note_end(self, events: int) -> None:
        """Remember the number of events at the end of the run; the first call counts."""
        if self.ended_after is None:
            self.ended_after = events


class ExceptionHandler(Protocol):
    """Handles the exceptions of participants."""

    def raised(self, error: BaseException, handle: Dispatchable) -> None:
        """Decide what becomes of the run after the current event raised ``error``."""


class ParticipantState(Protocol):
    """The hashed state of a participant."""

    def after_event(self) -> int:
        """Return the hash now, 0 if there is none."""


class EventOwner(Protocol):
    """A participant, as the recording code sees it."""

    entity_id: int
    fully_qualified_name: str
    state: ParticipantState | None
    exception_handler: ExceptionHandler


class CurrentEvent(EventFields):
    """The current event: one object that each event fills in anew.

    What it sends leaves ``busy_ns`` later (execution times), and its executor is busy for
    ``took_ns``. A ``quiet`` event is recorded only if something comes of it. ``on_end`` is called
    after it. ``node`` is an ``EventOwner`` or None.
    """

    def __init__(self) -> None:
        self.handle: Dispatchable | None = None
        self.entity = 0
        self.node: Any = None
        self.kind = 0
        self.cause_event = NO_EVENT
        self.cause_output = 0
        self.input_hash = 0
        self.flags = 0
        self.quiet = False
        self.on_end: Callable[[], None] | None = None
        self.busy_ns = 0
        self.took_ns = 0


class OutsideEvent:
    """The handle of an event that is not an entity's callback: construction, shutdown, a clock
    jump, a main, a thread."""

    def __init__(self, describe: Callable[[], str]) -> None:
        self.describe = describe

    def dispatch(self) -> None:
        raise AssertionError("never in a queue")
