"""Service introspection: what a service or client does, published as messages.

``configure_introspection`` of rclpy's services and clients opens a publisher of
``<service>/_service_event``; each request and response that is sent or received becomes a message
there, with its contents or without, as rcl publishes them.
"""

from __future__ import annotations

from typing import Any

from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.handles.pubsub import PublisherHandle
from rsltrace.simulation.middleware.services import RequestId

# Numbers of service_msgs/msg/ServiceEventInfo.
REQUEST_SENT, REQUEST_RECEIVED, RESPONSE_SENT, RESPONSE_RECEIVED = 0, 1, 2, 3
_OFF, _CONTENTS = 0, 2


class ServiceEvents:
    """The event publisher of one service or client, while introspection is on."""

    def __init__(self, node: NodeHandle, srv_type: Any, service: str, clock: Any, qos: Any) -> None:
        self._type = srv_type.Event
        self._clock = clock
        self._contents = False
        self.publisher = PublisherHandle(node, self._type, f"{service}/_service_event", qos)

    def set_state(self, state: int) -> None:
        """Publish contents, or metadata only."""
        self._contents = state == _CONTENTS

    def publish(self, event_type: int, request_id: RequestId, message: Any) -> None:
        """Tell of one request or response."""
        from builtin_interfaces.msg import Time
        from service_msgs.msg import ServiceEventInfo

        seconds, nanoseconds = divmod(self._clock.get_now().nanoseconds, 1_000_000_000)
        event = self._type(
            info=ServiceEventInfo(
                event_type=event_type,
                stamp=Time(sec=seconds, nanosec=nanoseconds),
                client_gid=list(request_id.client.entity_id.to_bytes(16, "big")),
                sequence_number=request_id.sequence_number,
            )
        )
        if self._contents:
            answers = event_type in (RESPONSE_SENT, RESPONSE_RECEIVED)
            setattr(event, "response" if answers else "request", [message])
        self.publisher.publish(event)

    def close(self) -> None:
        """Stop publishing."""
        if not self.publisher.destroyed:
            self.publisher.destroy_when_not_in_use()


def reconfigured(events: ServiceEvents | None, end: Any, clock: Any, qos: Any, state: Any) -> Any:
    """Return what ``end`` (a service or client) publishes its events with from now on, if at all.

    As in rcl, switching off destroys the publisher, and one that is there keeps clock and QoS.
    """
    if int(state) == _OFF:
        if events is not None:
            events.close()
        return None
    if events is None:
        events = ServiceEvents(end.node, end.srv_type, end.service, clock, qos)
    events.set_state(int(state))
    return events
