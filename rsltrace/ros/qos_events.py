"""QoS events of publishers and subscriptions: matched, and incompatible QoS.

Deadline, liveliness, lifespan and lost messages depend on time; their handles exist and never
become ready.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rsltrace.model.entity import EntityKind
from rsltrace.model.event import NO_EVENT, EventKind
from rsltrace.ros.entity_handle import EntityHandle, callback_name
from rsltrace.ros.groups import begin, is_busy
from rsltrace.ros.tasks import is_coroutine_function, start_coroutine

if TYPE_CHECKING:
    from rsltrace.ros.core import Core
    from rsltrace.ros.pubsub import PublisherHandle, SubscriptionHandle
    from rsltrace.ros.qos import PolicyKind

_QOS_EVENT = int(EventKind.QOS_EVENT)


@dataclass
class MatchedStatus:
    """Stands in for ``rmw_matched_status_t``."""

    total_count: int = 0
    total_count_change: int = 0
    current_count: int = 0
    current_count_change: int = 0


@dataclass
class IncompatibleQosStatus:
    """Stands in for ``rmw_requested_qos_incompatible_event_status_t``."""

    total_count: int = 0
    total_count_change: int = 0
    last_policy_kind: int = 1


@dataclass
class EndpointEvents:
    """The statuses of one endpoint, and the event handles that want to hear of them."""

    core: Core
    endpoint: PublisherHandle | SubscriptionHandle
    handles: dict[str, EventHandle] = field(default_factory=dict)
    match: MatchedStatus = field(default_factory=MatchedStatus)
    mismatch: IncompatibleQosStatus = field(default_factory=IncompatibleQosStatus)

    def matched(self, change: int) -> None:
        """Count a peer that came (+1) or went (-1)."""
        self.match.current_count += change
        self.match.current_count_change += change
        if change > 0:
            self.match.total_count += change
            self.match.total_count_change += change
        self._notify("matched")

    def incompatible(self, policy: PolicyKind) -> None:
        """Count a peer whose QoS does not fit."""
        self.mismatch.total_count += 1
        self.mismatch.total_count_change += 1
        self.mismatch.last_policy_kind = int(policy)
        self._notify("incompatible")

    def _notify(self, name: str) -> None:
        handle = self.handles.get(name)
        if handle is not None:
            handle.trigger()

    def news(self, name: str) -> bool:
        """Return whether there is something to take."""
        if name == "matched":
            return bool(self.match.total_count_change or self.match.current_count_change)
        return name == "incompatible" and bool(self.mismatch.total_count_change)

    def take(self, name: str) -> Any:
        """Return the status and forget its changes; None if there is nothing new."""
        if not self.news(name):
            return None
        if name == "matched":
            match = self.match
            taken = MatchedStatus(**vars(match))
            match.total_count_change = match.current_count_change = 0
            return taken
        taken_mismatch = IncompatibleQosStatus(**vars(self.mismatch))
        self.mismatch.total_count_change = 0
        return taken_mismatch


def _event_name(event_type: Any) -> str:
    name: str = event_type.name
    if name.endswith("_MATCHED"):
        return "matched"
    if name.endswith("_INCOMPATIBLE_QOS"):
        return "incompatible"
    return name.lower()


class EventHandle(EntityHandle):
    """Stands in for ``_rclpy.EventHandle``; its wrapper is rclpy's EventHandler waitable."""

    kind = EntityKind.QOS_EVENT
    lists = "waitables"

    def __init__(
        self, core: Core, parent: PublisherHandle | SubscriptionHandle, event_type: Any
    ) -> None:
        super().__init__(core, parent.node)
        # rclpy makes a handle or two for every endpoint; only those that fire are worth a record.
        self.announced = False
        self._events: EndpointEvents = parent.events
        self._parent = parent
        self._name = _event_name(event_type)
        self._queued = False
        self._cause = (NO_EVENT, 0)
        parent.events.handles[self._name] = self

    def find_wrapper(self) -> Any:
        if self.wrapper is None and self.node is not None and self.node.wrapper is not None:
            for waitable in self.node.wrapper.waitables:
                if getattr(waitable, "_EventHandler__event", None) is self:
                    self.wrapper = waitable
                    self.activate()
        return self.wrapper

    def activate(self) -> None:
        self.trigger()

    def trigger(self) -> None:
        """Make the callback ready."""
        if not self._queued and self.wrapper is not None and self._events.news(self._name):
            self._queued = True
            if not self.announced:
                self.announced = True
                self.core.pending.append(self)
            self._cause = (self.core.loop.events, 0)
            self.core.loop.ready.append(self)

    def take_event(self) -> Any:
        """Return the status, or None if there is nothing new."""
        return self._events.take(self._name)

    def dispatch(self) -> None:
        """Run the callback with the status."""
        wrapper = self.wrapper
        if wrapper is None or self._destroyed:
            return
        core = self.core
        group = wrapper.callback_group
        if is_busy(group, wrapper):
            core.park(group, lambda: core.loop.ready.appendleft(self))
            return
        self._queued = False
        status = self.take_event()
        if status is None:
            return
        callback = wrapper.callback
        if is_coroutine_function(callback):
            begin(group, wrapper)
            start_coroutine(core, self, _QOS_EVENT, callback, (status,), *self._cause, 0)
        else:
            core.execute(
                self, self.entity_id, self.node, _QOS_EVENT, callback, (status,), *self._cause, 0
            )

    def settle(self) -> bool:
        self.find_wrapper()
        return True

    def trace_name(self) -> str:
        return f"{self._parent.topic} {self._name}"

    def trace_detail(self) -> dict[str, object]:
        return {"callback": callback_name(getattr(self.wrapper, "callback", None))}
