"""The handles of QoS events: callbacks that run when a status of an endpoint has news."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rsltrace.adapters.rclpy.handles.entity_handle import Alarm, EntityHandle
from rsltrace.adapters.rclpy.handles.pubsub import PublisherHandle, SubscriptionHandle
from rsltrace.adapters.rclpy.stacks.tasks import is_awaited, start_callback
from rsltrace.simulation.middleware.entity import callback_name
from rsltrace.simulation.middleware.participant import QosEvent
from rsltrace.simulation.middleware.qos.status import (
    DEADLINE_MISSED,
    INCOMPATIBLE,
    LIVELINESS_CHANGED,
    LIVELINESS_LOST,
    MATCHED,
    MESSAGE_LOST,
)
from rsltrace.trace.model.event import EventKind

_QOS_EVENT = int(EventKind.QOS_EVENT)


_NAMES = {
    "MATCHED": MATCHED,
    "INCOMPATIBLE_QOS": INCOMPATIBLE,
    "DEADLINE_MISSED": DEADLINE_MISSED,
    "LIVELINESS_CHANGED": LIVELINESS_CHANGED,
    "LIVELINESS_LOST": LIVELINESS_LOST,
    "MESSAGE_LOST": MESSAGE_LOST,
}


def _event_name(event_type: Any) -> str:
    name: str = event_type.name
    for ending, ours in _NAMES.items():
        if name.endswith(ending):
            return ours
    return name.lower()


class EventHandle(QosEvent, EntityHandle):
    """Stands in for ``_rclpy.EventHandle``; its wrapper is rclpy's EventHandler waitable.
    ``alarms`` hear of every trigger."""

    lists = "waitables"
    alarms: tuple[Alarm, ...] = ()

    def __init__(self, parent: PublisherHandle | SubscriptionHandle, event_type: Any) -> None:
        self.stacks = parent.stacks
        super().__init__(parent.dispatcher, parent.node)
        self.listen(parent, _event_name(event_type))

    def _listed_by(self, node: Any) -> Iterator[tuple[Any, Any]]:
        for waitable in node.waitables:
            handle = getattr(waitable, "_EventHandler__event", None)
            if handle is not None:
                yield handle, waitable

    def activate(self) -> None:
        self.trigger()

    def trigger(self) -> None:
        super().trigger()
        for alarm in self.alarms:
            alarm()

    def dispatch(self) -> None:
        """Run the callback with the status."""
        if self.mailbox_keeps():
            return
        wrapper = self.wrapper
        if wrapper is None or self.destroyed:
            return
        if not self.has_news():
            self.is_queued = False
            return
        if self.stacks.groups.must_wait(self, wrapper):
            return
        self.is_queued = False
        status = self.take_event()
        callback = wrapper.callback
        if is_awaited(self.stacks, callback):
            start_callback(self.stacks, self, _QOS_EVENT, callback, (status,), *self.cause, 0)
        else:
            self.dispatcher.execute(
                self, self.entity_id, self.node, _QOS_EVENT, callback, (status,), *self.cause, 0
            )

    def settle(self) -> bool:
        self.find_wrapper()
        return True

    def trace_detail(self) -> dict[str, object]:
        return {"callback": callback_name(self.user_callback())}
