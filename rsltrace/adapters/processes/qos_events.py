"""QoS events of processes: news of an endpoint's status, handed over when it is waited for."""

from __future__ import annotations

import struct
from dataclasses import astuple

from rsltrace.adapters.processes.endpoints import Host, ProcessSubscription
from rsltrace.adapters.processes.wire import Ready, packed_item
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.simulation.middleware.qos_events import QosEvent
from rsltrace.trace.model.event import EventKind

_QOS_EVENT = int(EventKind.QOS_EVENT)
_NO_GID = bytes(16)


class ProcessQosEvent(QosEvent):
    """A status that a process wants to hear of. ``number`` is what the process calls it."""

    def __init__(
        self, process: Host, number: int, end: Publisher | ProcessSubscription, status: str
    ) -> None:
        super().__init__(process.dispatcher, end.node)
        self.dispatcher.entities.pending.remove(self)  # it may fire at once, and is told of then
        self.process = process
        self.number = number
        self.listen(end, status)
        self.trigger()

    def dispatch(self) -> None:
        """Hand the status over, if it has not been taken and the process waits for it."""
        if self.destroyed:
            return
        if not self.has_news():
            self.is_queued = False
        elif not self.process.wants(self):
            self.process.hold(self)
        else:
            self.is_queued = False
            self.dispatcher.execute(
                self,
                self.entity_id,
                self.node,
                _QOS_EVENT,
                self.process.go_on_with,
                (self.number, Ready.ENTITY, self.take()),
                *self.cause,
                0,
            )

    def may_run(self) -> bool:
        """Return whether there is a status to hand over."""
        return self.has_news()

    def take(self) -> bytes:
        """Return the status, packed."""
        counts = astuple(self.take_event())
        return packed_item(0, 0, 0, 0, _NO_GID, struct.pack(f"<{len(counts)}q", *counts))

    def _destroy(self) -> None:
        super()._destroy()
        listeners = self.endpoint.events.listeners
        if listeners.get(self.status) is self:
            del listeners[self.status]
