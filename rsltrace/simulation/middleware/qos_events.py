"""QoS events: news of an endpoint's status, for whoever wants to hear of it."""

from __future__ import annotations

from typing import Any, Protocol

from rsltrace.simulation.middleware.entity import DomainEntity
from rsltrace.simulation.middleware.qos.status import EndpointEvents
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT


class Endpoint(Protocol):
    """A publisher or subscription, as its QoS events see it."""

    topic: str
    events: EndpointEvents


class QosEvent(DomainEntity):
    """Becomes ready when one status of an endpoint has news. ``cause`` is the event that made them.

    Client libraries make one or two for every endpoint; the trace is told of those that fire.
    """

    kind = EntityKind.QOS_EVENT

    def listen(self, endpoint: Endpoint, status: str) -> None:
        """Hear of a status from now on, by its name."""
        self.announced = False
        self.endpoint = endpoint
        self.status = status
        self.is_queued = False
        self.cause = (NO_EVENT, 0)
        endpoint.events.listeners[status] = self

    def trigger(self) -> None:
        """Make it ready, if there is news."""
        if self.is_queued or not self.active or not self.has_news():
            return
        self.is_queued = True
        if not self.announced:
            self.announced = True
            self.dispatcher.entities.pending.append(self)
        self.cause = (self.dispatcher.loop.events, 0)
        self.dispatcher.loop.ready.append(self)

    def dispatch(self) -> None:
        """Hand the status over."""
        raise AssertionError("every QoS event says how")

    def has_news(self) -> bool:
        """Return whether there is a status to take."""
        return self.endpoint.events.news(self.status)

    def take_event(self) -> Any:
        """Return the status; its changes are those since the last time."""
        return self.endpoint.events.take(self.status)

    def trace_name(self) -> str:
        return f"{self.endpoint.topic} {self.status}"
