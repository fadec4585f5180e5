"""A lifecycle node and who manages it; a node that makes a service without ``create_service``."""

from __future__ import annotations

from typing import Any

from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import QoSPresetProfiles
from rclpy.service import Service
from rclpy.type_support import check_is_valid_srv_type
from std_msgs.msg import Bool, Float64

STEPS = (
    Transition.TRANSITION_CONFIGURE,
    Transition.TRANSITION_ACTIVATE,
    Transition.TRANSITION_DEACTIVATE,
    Transition.TRANSITION_CLEANUP,
)


def say_when_found(node: Node) -> None:
    """Publish on ``/found`` once the manager hears a node: it hears the manager, too."""

    def look() -> None:
        if found.get_subscription_count():
            timer.cancel()
            found.publish(Bool(data=True))

    found = node.create_publisher(Bool, "/found", 10)
    timer = node.create_timer(0.1, look)


class Managed(LifecycleNode):
    """Publishes once each time it is activated."""

    def __init__(self) -> None:
        super().__init__("managed")
        self.sender = self.create_lifecycle_publisher(Float64, "/level", 10)
        say_when_found(self)

    def on_activate(self, state: Any) -> TransitionCallbackReturn:
        done = super().on_activate(state)
        self.sender.publish(Float64(data=1.0))
        return done


class ByHand(Node):
    """Serves ``/by_hand`` by a service of its own making."""

    def __init__(self) -> None:
        super().__init__("by_hand")
        check_is_valid_srv_type(GetState)  # and load its type support
        qos = QoSPresetProfiles.SERVICES_DEFAULT.value
        with self.handle:
            handle = _rclpy.Service(self.handle, GetState, "/by_hand", qos.get_c_qos_profile())
        group = self.default_callback_group
        service = Service(handle, GetState, "/by_hand", self.serve, group, qos)
        group.add_entity(service)
        self._services.append(service)
        say_when_found(self)

    def serve(self, request: Any, response: Any) -> Any:
        self.get_logger().info("served")
        return response


class Manager(Node):
    """Goes through the states of ``/managed``, one step after the other's answer, then asks
    ``/by_hand``, and says on ``/over`` that it has heard of all."""

    def __init__(self) -> None:
        super().__init__("manager")
        self.steps = iter(STEPS)
        self.left = 2 * len(STEPS) + 1  # transitions and the last answer
        self.changes = self.create_client(ChangeState, "/managed/change_state")
        self.other = self.create_client(GetState, "/by_hand")
        self.over = self.create_publisher(Bool, "/over", 10)
        self.create_subscription(TransitionEvent, "/managed/transition_event", self.hear, 10)
        # The last that it makes: who sees it has seen the others.
        self.create_subscription(Bool, "/found", self.begin, 10)
        self.timer = self.create_timer(0.1, self.look)
        self.timer.cancel()
        self.unknown = 2

    def begin(self, message: Bool) -> None:
        self.unknown -= 1
        if not self.unknown:
            self.timer.reset()

    def look(self) -> None:
        if self.changes.service_is_ready() and self.other.service_is_ready():
            self.timer.cancel()
            self.go_on(None)

    def go_on(self, future: Any) -> None:
        step = next(self.steps, None)
        if step is None:
            self.other.call_async(GetState.Request()).add_done_callback(self.count)
        else:
            request = ChangeState.Request(transition=Transition(id=step))
            self.changes.call_async(request).add_done_callback(self.go_on)

    def hear(self, event: Any) -> None:
        self.get_logger().info(f"{event.start_state.label} to {event.goal_state.label}")
        self.count(None)

    def count(self, future: Any) -> None:
        self.left -= 1
        if not self.left:
            self.over.publish(Bool(data=True))
