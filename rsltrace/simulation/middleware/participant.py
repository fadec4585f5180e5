"""Participants, which are nodes in ROS, and their QoS events."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

from rsltrace.simulation.middleware.entity import DomainEntity, callback_name
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.event import ExceptionHandler, ParticipantState
from rsltrace.simulation.middleware.qos.timing import EndpointEvents
from rsltrace.simulation.middleware.timer import Timer
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT


class QosEndpoint(Protocol):
    """A publisher or subscription, as its QoS events see it."""

    topic: str
    events: EndpointEvents


class QosEvent(DomainEntity):
    """Becomes ready when a status of an endpoint changes. ``cause`` is the event that changed it.

    Client libraries make one or two for every endpoint; the trace has those that fire.
    """

    kind = EntityKind.QOS_EVENT

    def listen(self, endpoint: QosEndpoint, status: str) -> None:
        self.announced = False
        self.endpoint = endpoint
        self.status = status
        self.is_queued = False
        self.cause = (NO_EVENT, 0)
        endpoint.events.listeners[status] = self

    def trigger(self) -> None:
        if self.is_queued or not self.active or not self.has_news():
            return
        self.is_queued = True
        if not self.announced:
            self.announced = True
            self.dispatcher.entities.pending.append(self)
        self.cause = (self.dispatcher.loop.events, 0)
        self.dispatcher.loop.ready.append(self)

    def dispatch(self) -> None:
        raise AssertionError("every QoS event says how")

    def has_news(self) -> bool:
        return self.endpoint.events.news(self.status)

    def take_event(self) -> Any:
        """Return the status with the changes since the last call."""
        return self.endpoint.events.take(self.status)

    def trace_name(self) -> str:
        return f"{self.endpoint.topic} {self.status}"


class NodeAction(Protocol):
    """A client or a server of an action, which is made of other endpoints."""

    name: str
    is_client: bool

    @property
    def type_name(self) -> str:
        """The name of the action's type."""


_ENTITIES_PER_NODE_MAX = 1 << 20


class Participant(DomainEntity):
    """A node.

    ``exception_handler`` handles its exceptions. ``process`` is set if its process may end before
    the run.
    ``number`` distinguishes nodes of the same name, in order of creation.
    """

    kind = EntityKind.NODE
    process: object = None
    held: list[Any] | None = None
    """What waits to run, besides its callbacks, while it hangs."""
    number = 1

    def __init__(
        self, dispatcher: Dispatcher, name: str, namespace: str, exception_handler: ExceptionHandler
    ) -> None:
        super().__init__(dispatcher, None)
        self.node = self
        self.name = name
        self.namespace = namespace
        self.fully_qualified_name = full_name(namespace, name)
        self.exception_handler = exception_handler
        self.state: ParticipantState | None = None
        self.actions: list[NodeAction] = []
        self.timers: list[Timer] = []

    @property
    def key(self) -> str:
        """The full name, with the number of a namesake: ``/n #2``."""
        name = self.fully_qualified_name
        return name if self.number == 1 else f"{name} #{self.number}"

    def ordinal(self, count: int) -> int:
        """Return a number that no namesake of this node uses for the same kind of entity."""
        return count + (self.number - 1) * _ENTITIES_PER_NODE_MAX

    def timer_periods(self) -> Iterable[tuple[str, int]]:
        return ((callback_name(timer.callback), timer.state.period_ns) for timer in self.timers)

    def shortest_period_ns(self) -> int | None:
        return min((period_ns for _, period_ns in self.timer_periods()), default=None)

    def trace_name(self) -> str:
        return self.fully_qualified_name

    def describe(self) -> str:
        return self.fully_qualified_name


def full_name(namespace: str, name: str) -> str:
    return (namespace if namespace.endswith("/") else namespace + "/") + name
