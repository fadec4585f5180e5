"""QoS events of processes: news of an endpoint's status, handed over when it is waited for."""

from __future__ import annotations

import struct
from dataclasses import astuple

from rsltrace.doors.processes.endpoints import Host, ProcessSubscription
from rsltrace.doors.processes.wire import Ready, packed_item
from rsltrace.middleware.entity import DomainEntity
from rsltrace.middleware.publisher import Publisher
from rsltrace.model.entity import EntityKind
from rsltrace.model.event import NO_EVENT, EventKind

_QOS_EVENT = int(EventKind.QOS_EVENT)
_NO_GID = bytes(16)


class ProcessQosEvent(DomainEntity):
    """One status of an endpoint that a process wants to hear of. ``status`` is its name."""

    kind = EntityKind.QOS_EVENT

    def __init__(
        self, process: Host, number: int, end: Publisher | ProcessSubscription, status: str
    ) -> None:
        super().__init__(process.dispatcher, end.node)
        # Client libraries make one or two for every endpoint; those that fire are worth a record.
        self.announced = False
        self.dispatcher.entities.pending.remove(self)
        self.process = process
        self.number = number
        self._end = end
        self._status = status
        self._queued = False
        self._cause = (NO_EVENT, 0)
        end.events.listeners[status] = self
        self.trigger()

    def trigger(self) -> None:
        """Make it ready, if there is news."""
        if self._queued or not self._end.events.news(self._status):
            return
        self._queued = True
        if not self.announced:
            self.announced = True
            self.dispatcher.entities.pending.append(self)
        self._cause = (self.dispatcher.loop.events, 0)
        self.dispatcher.loop.ready.append(self)

    def dispatch(self) -> None:
        """Hand the status over, if it has not been taken and the process waits for it."""
        if self.destroyed:
            return
        if not self._end.events.news(self._status):
            self._queued = False
        elif not self.process.wants(self):
            self.process.hold(self)
        else:
            self._queued = False
            self.dispatcher.execute(
                self,
                self.entity_id,
                self.node,
                _QOS_EVENT,
                self.process.go_on_with,
                (self.number, Ready.ENTITY, self.take()),
                *self._cause,
                0,
            )

    def take(self) -> bytes:
        """Return the status; its changes are those since the last time."""
        counts = astuple(self._end.events.take(self._status))
        return packed_item(0, 0, 0, 0, _NO_GID, struct.pack(f"<{len(counts)}q", *counts))

    def trace_name(self) -> str:
        return f"{self._end.topic} {self._status}"

    def _destroy(self) -> None:
        super()._destroy()
        listeners = self._end.events.listeners
        if listeners.get(self._status) is self:
            del listeners[self._status]
