"""Lifecycle nodes through rclpy's own Python layer."""

from __future__ import annotations

from typing import Any

import pytest
from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from std_msgs.msg import UInt64

pytestmark = pytest.mark.ros
LOG: list[Any] = []


class Camera(LifecycleNode):
    """Publishes while active; its first activation fails, its cleanup raises."""

    def __init__(self) -> None:
        super().__init__("camera")
        self.activations = 0

    def on_configure(self, state: Any) -> Any:
        LOG.append(f"configure from {state.label}")
        self.images = self.create_lifecycle_publisher(UInt64, "images", 10)
        self.create_timer(0.5, lambda: self.images.publish(UInt64()))
        return super().on_configure(state)

    def on_activate(self, state: Any) -> Any:
        self.activations += 1
        if self.activations == 1:
            return TransitionCallbackReturn.FAILURE
        return super().on_activate(state)

    def on_cleanup(self, state: Any) -> Any:
        raise RuntimeError("lens stuck")

    def on_error(self, state: Any) -> Any:
        LOG.append("error handled")
        return TransitionCallbackReturn.SUCCESS


class Manager(Node):
    """Takes the camera through its life by service, one transition a second."""

    STEPS = (
        Transition.TRANSITION_CONFIGURE,
        Transition.TRANSITION_ACTIVATE,
        Transition.TRANSITION_ACTIVATE,
        Transition.TRANSITION_DEACTIVATE,
        Transition.TRANSITION_CLEANUP,
    )

    def __init__(self) -> None:
        super().__init__("manager")
        group = ReentrantCallbackGroup()
        self.change = self.create_client(ChangeState, "/camera/change_state", callback_group=group)
        self.state = self.create_client(GetState, "/camera/get_state", callback_group=group)
        self.steps = list(self.STEPS)
        self.create_timer(1.0, self.step)
        self.create_subscription(UInt64, "images", lambda m: LOG.append("image"), 10)

    def step(self) -> None:
        if self.steps:
            transition = Transition(id=self.steps.pop(0))
            answer = self.change.call(ChangeState.Request(transition=transition))
            state = self.state.call(GetState.Request()).current_state
            LOG.append((answer.success, state.label))


def test_a_life_by_service(simulate: Any) -> None:
    LOG.clear()
    recorded = simulate(Camera, Manager, duration=6.2)
    assert LOG == [
        "configure from unconfigured",
        (True, "inactive"),
        (False, "inactive"),
        (True, "active"),
        "image",
        "image",
        (True, "inactive"),
        "error handled",
        (False, "unconfigured"),
    ]
    with recorded.trace() as trace:
        events = [
            trace.decode("/camera/transition_event", data)
            for _, _, data in trace.messages("/camera/transition_event")
        ]
    assert [(e.start_state.label, e.goal_state.label) for e in events[:4]] == [
        ("unconfigured", "configuring"),
        ("configuring", "inactive"),
        ("inactive", "activating"),
        ("activating", "inactive"),
    ]


def test_transitions_by_code_and_what_is_not_allowed(simulate: Any) -> None:
    seen: list[Any] = []

    class Own(LifecycleNode):
        def __init__(self) -> None:
            super().__init__("own")
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            from rclpy.impl.implementation_singleton import rclpy_implementation

            refused = "Transition is not registered"
            try:
                assert self.trigger_activate() is TransitionCallbackReturn.ERROR
            except rclpy_implementation.RCLError as error:  # Jazzy's rclpy raises
                refused = str(error)
            assert "Transition is not registered" in refused
            assert self._state_machine.current_state == (1, "unconfigured")
            seen.append(self.trigger_configure())
            seen.append(self.trigger_activate())
            seen.append(self.trigger_shutdown())
            seen.append(self._state_machine.current_state)

    simulate(Own, duration=1)
    success = TransitionCallbackReturn.SUCCESS
    assert seen == [success, success, success, (State.PRIMARY_STATE_FINALIZED, "finalized")]


def test_the_transition_graph_is_rcl_lifecycles(simulate: Any) -> None:
    seen: list[Any] = []

    class Asker(Node):
        def __init__(self) -> None:
            super().__init__("asker")
            self.client = self.create_client(
                GetAvailableTransitions, "/camera/get_available_transitions"
            )
            self.create_timer(1.0, self.ask)

        def ask(self) -> None:
            future = self.client.call_async(GetAvailableTransitions.Request())
            future.add_done_callback(lambda f: seen.append(f.result().available_transitions))

    simulate(Camera, Asker, duration=1)
    described = [(t.transition.label, t.start_state.label, t.goal_state.label) for t in seen[0]]
    assert described == [
        ("configure", "unconfigured", "configuring"),
        ("shutdown", "unconfigured", "shuttingdown"),
    ]
    assert TransitionEvent  # the topic's type is there for subscribers
