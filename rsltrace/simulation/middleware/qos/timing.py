"""QoS that depends on time: deadlines, and the liveliness of publishers.

A timer looks at the clock only when its period may be over, and only where a callback listens, so
that a run without one can still end because nothing is left. The behaviour follows Fast DDS;
``tests/middleware/test_qos_native.py`` compares the two.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import fields, replace
from typing import Any

from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.middleware.qos.policies import INFINITE_NS, Liveliness, PolicyKind, Qos

# The QoS statuses of an endpoint: counts, as DDS keeps them.


MATCHED = "matched"
INCOMPATIBLE = "incompatible"
MESSAGE_LOST = "message_lost"
DEADLINE_MISSED = "deadline_missed"
LIVELINESS_CHANGED = "liveliness_changed"
LIVELINESS_LOST = "liveliness_lost"


@dataclass
class MatchedStatus:
    """``rmw_matched_status_t``."""

    total_count: int = 0
    total_count_change: int = 0
    current_count: int = 0
    current_count_change: int = 0


@dataclass
class IncompatibleQosStatus:
    """``rmw_requested_qos_incompatible_event_status_t``."""

    total_count: int = 0
    total_count_change: int = 0
    last_policy_kind: int = 1


@dataclass
class CountStatus:
    """The statuses that only count: deadlines, lost messages, lost liveliness."""

    total_count: int = 0
    total_count_change: int = 0


@dataclass
class LivelinessChangedStatus:
    """``rmw_liveliness_changed_status_t``: publishers that are alive, or not."""

    alive_count: int = 0
    not_alive_count: int = 0
    alive_count_change: int = 0
    not_alive_count_change: int = 0


_KINDS: dict[str, type] = {
    MATCHED: MatchedStatus,
    INCOMPATIBLE: IncompatibleQosStatus,
    LIVELINESS_CHANGED: LivelinessChangedStatus,
}


class EndpointEvents:
    """The statuses of one endpoint, and their listeners."""

    __slots__ = ("_statuses", "listeners")

    def __init__(self) -> None:
        self.listeners: dict[str, Any] = {}  # QosEvents, by status
        self._statuses: dict[str, Any] = {}

    def matched(self, change: int) -> None:
        """Count a peer that connected (+1) or disconnected (-1)."""
        self.add(MATCHED, current=change, **({"total": change} if change > 0 else {}))

    def incompatible(self, policy: PolicyKind) -> None:
        self._status(INCOMPATIBLE).last_policy_kind = int(policy)
        self.add(INCOMPATIBLE, total=1)

    def add(self, name: str, **changes: int) -> None:
        """Add to counts (``total=1`` adds to ``total_count`` and to its change)."""
        status = self._status(name)
        for count, change in changes.items():
            field = f"{count}_count"
            setattr(status, field, getattr(status, field) + change)
            field += "_change"
            setattr(status, field, getattr(status, field) + change)
        listener = self.listeners.get(name)
        if listener is not None:
            listener.trigger()

    def news(self, name: str) -> bool:
        status = self._statuses.get(name)
        return status is not None and any(getattr(status, field) for field in _changes(status))

    def take(self, name: str) -> Any:
        """Return the status and reset its changes."""
        status = self._status(name)
        taken = replace(status)
        for field in _changes(status):
            setattr(status, field, 0)
        return taken

    def _status(self, name: str) -> Any:
        status = self._statuses.get(name)
        if status is None:
            status = self._statuses[name] = _KINDS.get(name, CountStatus)()
        return status


def _changes(status: Any) -> list[str]:
    return [field.name for field in fields(status) if field.name.endswith("_change")]


class _QosTimer(ABC):
    """Calls ``_up`` when nothing was seen for ``period_ns`` and a callback wants ``status``."""

    status: str

    def __init__(self, loop: EventLoop, period_ns: int, events: EndpointEvents) -> None:
        self._loop = loop
        self._period_ns = period_ns
        self._events = events
        self._due_ns = -1
        self._scheduled = False
        self.over = False

    def seen(self) -> None:
        """Start a new period."""
        self._due_ns = self._loop.now_ns + self._period_ns
        if not self._scheduled:
            self._schedule()

    def _schedule(self) -> None:
        if self.status in self._events.listeners:
            self._scheduled = True
            self._loop.schedule(self._due_ns, self._look)

    def _look(self) -> None:
        self._scheduled = False
        if self.over:
            return
        if self._loop.now_ns >= self._due_ns:
            self._up()
        elif self._due_ns > 0:
            self._schedule()

    @abstractmethod
    def _up(self) -> None:
        """Report that the period is over."""


class DeadlineTimer(_QosTimer):
    """Counts the periods without a message, from the first message on."""

    status = DEADLINE_MISSED

    def _up(self) -> None:
        self._events.add(DEADLINE_MISSED, total=1)
        self._due_ns += self._period_ns
        self._schedule()


class OfferedLease(_QosTimer):
    """Notices that a publisher with manual liveliness has not shown life in time."""

    status = LIVELINESS_LOST

    def _up(self) -> None:
        self._events.add(LIVELINESS_LOST, total=1)


class RequestedLease(_QosTimer):
    """Whether a subscription considers one publisher alive.

    With automatic liveliness the publisher is alive as long as it exists and can be heard; with
    manual liveliness from its first sign of life until a lease passes without another.
    """

    status = LIVELINESS_CHANGED

    def __init__(
        self, loop: EventLoop, lease_ns: int, kind: Liveliness, events: EndpointEvents
    ) -> None:
        super().__init__(loop, lease_ns, events)
        self._manual = kind is Liveliness.MANUAL_BY_TOPIC
        self._alive: bool | None = None
        if not self._manual:
            self._becomes(True)

    def seen(self) -> None:
        if self._manual:
            self._becomes(True)
            super().seen()

    def cut_off(self, from_ns: int, to_ns: int) -> None:
        """Lose liveliness during an outage longer than the lease."""
        if not self._manual and to_ns - from_ns > self._period_ns:
            at_ns = from_ns + self._period_ns
            self._loop.schedule(at_ns, lambda: self._becomes(False))
            self._loop.schedule(to_ns, lambda: self._becomes(True))

    def gone(self) -> None:
        if self._alive is not None:
            self._events.add(LIVELINESS_CHANGED, **{_NAME[self._alive]: -1})
        self._alive = None
        self.over = True

    def _up(self) -> None:
        self._becomes(False)

    def _becomes(self, alive: bool) -> None:
        if alive is self._alive or self.over:
            return
        changes = {_NAME[alive]: 1}
        if self._alive is not None:
            changes[_NAME[self._alive]] = -1
        self._alive = alive
        self._events.add(LIVELINESS_CHANGED, **changes)


_NAME = {True: "alive", False: "not_alive"}


def finite(duration_ns: int) -> bool:
    return 0 < duration_ns < INFINITE_NS


class OfferedQosTimers:
    """The deadline of a publisher, and its manual liveliness."""

    def __init__(self, loop: EventLoop, qos: Qos, events: EndpointEvents) -> None:
        self._watches: list[_QosTimer] = []
        self._lease: OfferedLease | None = None
        if finite(qos.deadline_ns):
            self._watches.append(DeadlineTimer(loop, qos.deadline_ns, events))
        if qos.liveliness is Liveliness.MANUAL_BY_TOPIC and finite(qos.lease_ns):
            self._lease = OfferedLease(loop, qos.lease_ns, events)
            self._watches.append(self._lease)

    @classmethod
    def of(cls, loop: EventLoop, qos: Qos, events: EndpointEvents) -> OfferedQosTimers | None:
        """Return the timers of a profile, or None if it needs none."""
        offers = cls(loop, qos, events)
        return offers if offers._watches else None

    def sent(self) -> None:
        for watch in self._watches:
            watch.seen()

    def asserted(self) -> None:
        if self._lease is not None:
            self._lease.seen()

    def end(self) -> None:
        for watch in self._watches:
            watch.over = True
