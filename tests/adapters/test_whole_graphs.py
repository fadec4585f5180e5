"""Graphs of executables that call each other: nested calls, missing servers, servers that die."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest
import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from rsltrace.errors import DeadlockError
from tests.adapters.test_mains import main_spec, seconds

pytestmark = pytest.mark.ros


class Link(Node):
    """Serves ``name`` by calling ``next_one`` within its callback, and by some work of its own."""

    def __init__(self, name: str, next_one: str | None) -> None:
        super().__init__(name)
        self.next: Any = None
        if next_one is not None:
            group = ReentrantCallbackGroup()
            self.next = self.create_client(Trigger, next_one, callback_group=group)
        self.create_service(Trigger, name, self.answer)

    def answer(self, request: Any, response: Any) -> Any:
        time.sleep(0.1)
        below = self.next.call(request).message if self.next is not None else "end"
        response.message = f"{self.get_name()}({below})"
        return response


def link(name: str, next_one: str | None) -> Any:
    """An executable with one link, spun by several threads."""

    def main() -> None:
        rclpy.init()
        executor = MultiThreadedExecutor(2)
        executor.add_node(Link(name, next_one))
        try:
            executor.spin()
        except (KeyboardInterrupt, ExternalShutdownException):
            executor.shutdown()

    return main_spec(main)


def asker(log: list[Any]) -> Any:
    def main() -> None:
        rclpy.init()
        node = Node("asker")
        group = ReentrantCallbackGroup()
        client = node.create_client(Trigger, "first", callback_group=group)

        def ask() -> None:
            log.append((client.call(Trigger.Request()).message, seconds(node)))

        node.create_timer(1.0, ask, callback_group=group)
        executor = MultiThreadedExecutor(2)
        executor.add_node(node)
        executor.spin()

    return main_spec(main)


@pytest.mark.parametrize("as_mains", [True, False])
def test_blocking_calls_in_callbacks_two_deep(simulate: Any, as_mains: bool) -> None:
    log: list[Any] = []
    names = [("first", "second"), ("second", "third"), ("third", None)]
    links = [link(*n) if as_mains else (lambda n=n: Link(*n)) for n in names]
    simulate(asker(log), *links, duration=3)
    assert log == [("first(second(third(end)))", 1.3), ("first(second(third(end)))", 2.3)]


def test_the_same_with_a_missing_server_is_a_deadlock_that_names_both_sides(simulate: Any) -> None:
    log: list[Any] = []
    with pytest.raises(DeadlockError) as caught:
        simulate(asker(log), link("first", "second"), link("second", "third"))
    text = str(caught.value)
    assert log == []
    for who, what in (
        ("first: service /first", "/second (1 server)"),
        ("second: service /second", "/third (0 servers)"),
    ):
        assert f"/{who} waits for the response to a service call, of {what}" in text
    assert text.count("in answer") == 2
    assert "/asker: timer" in text


def test_an_action_server_that_dies_during_a_goal(simulate: Any) -> None:
    actions = pytest.importorskip("test_msgs.action", reason="needs ros-jazzy-test-msgs")
    log: list[Any] = []

    def server() -> None:
        rclpy.init()
        node = Node("server")

        def work(goal: Any) -> Any:
            for _ in range(3):
                goal.publish_feedback(actions.Fibonacci.Feedback(sequence=[1]))
                time.sleep(1.0)
            raise SystemExit(9)

        ActionServer(node, actions.Fibonacci, "fibonacci", work)
        rclpy.spin(node)

    def client() -> None:
        rclpy.init()
        node = Node("client")
        client = ActionClient(node, actions.Fibonacci, "fibonacci")
        assert client.wait_for_server()
        sent = client.send_goal_async(
            actions.Fibonacci.Goal(order=3), lambda m: log.append(seconds(node))
        )
        rclpy.spin_until_future_complete(node, sent)
        result = sent.result().get_result_async()
        rclpy.spin_until_future_complete(node, result, timeout_sec=5.0)
        log.append((result.done(), client.server_is_ready(), seconds(node)))
        rclpy.spin_until_future_complete(node, result)

    with pytest.raises(DeadlockError) as caught:
        simulate(main_spec(client), main_spec(server))
    assert log == [0.25, 1.25, 2.25, (False, False, 5.25)]
    text = str(caught.value)
    assert "client waits for a future to be completed: the result of a goal" in text
    assert "of action /fibonacci (0 servers)" in text
    assert "server exited with 9 at 3.250000000 s" in text


def test_a_lifecycle_node_and_parameters_of_another_main(simulate: Any) -> None:
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState
    from rcl_interfaces.srv import GetParameters
    from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

    log: list[Any] = []

    class Managed(LifecycleNode):
        def __init__(self) -> None:
            super().__init__("managed")
            self.declare_parameter("gain", 1.0)

        def on_configure(self, state: Any) -> Any:
            log.append("configured")
            return TransitionCallbackReturn.SUCCESS

        def on_activate(self, state: Any) -> Any:
            log.append("refuses to be active")
            return TransitionCallbackReturn.FAILURE

    def managed() -> None:
        rclpy.init()
        rclpy.spin(Managed())

    def manager() -> None:
        rclpy.init()
        node = Node("manager")
        executor = MultiThreadedExecutor()
        executor.add_node(node)
        threading.Thread(target=executor.spin, daemon=True).start()
        change = node.create_client(ChangeState, "/managed/change_state")
        change.wait_for_service()
        for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            request = ChangeState.Request(transition=Transition(id=transition))
            log.append(change.call(request).success)
        get = node.create_client(GetParameters, "/managed/get_parameters")
        answer = get.call(GetParameters.Request(names=["gain"]))
        log.append(answer.values[0].double_value)

    simulate(main_spec(manager), main_spec(managed, parameters={"gain": 4.5}), duration=5)
    assert log == ["configured", True, "refuses to be active", False, 4.5]
