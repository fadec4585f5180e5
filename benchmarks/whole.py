"""Nodes and mains for measuring what actions and suspended call stacks cost."""

from __future__ import annotations

import threading
from typing import Any

import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import UInt8
from std_srvs.srv import Trigger

FEEDBACKS = 3


class Worker(Node):
    """An action server: every goal gets a few feedbacks and a result, which is soon forgotten."""

    def __init__(self) -> None:
        from test_msgs.action import Fibonacci

        super().__init__("worker")
        self.callbacks = 0
        self._feedback = Fibonacci.Feedback(sequence=[0, 1])
        self._result = Fibonacci.Result(sequence=[0, 1])
        self._server = ActionServer(self, Fibonacci, "work", self._work, result_timeout=0.02)

    def _work(self, goal: Any) -> Any:
        self.callbacks += 1
        for _ in range(FEEDBACKS):
            goal.publish_feedback(self._feedback)
        goal.succeed()
        return self._result


class Asker(Node):
    """An action client: a goal with every tick of a timer, unless the last one is not done.

    Parameters: ``goals``, how many, then 0 is published on /asker/done (0: it never ends);
    ``period``, seconds.
    """

    def __init__(self) -> None:
        from test_msgs.action import Fibonacci

        super().__init__("asker")
        self.callbacks = 0
        self._goal = Fibonacci.Goal(order=1)
        self._left = self.declare_parameter("goals", 0).value or -1
        self._idle = True
        self._client = ActionClient(self, Fibonacci, "work")
        self._done = self.create_publisher(UInt8, "/asker/done", 10)
        self.create_timer(self.declare_parameter("period", 0.001).value, self._ask)

    def _ask(self) -> None:
        self.callbacks += 1
        if self._idle and self._client.server_is_ready():
            self._idle = False
            future = self._client.send_goal_async(self._goal, self._heard)
            future.add_done_callback(self._accepted)

    def _heard(self, message: Any) -> None:
        self.callbacks += 1

    def _accepted(self, future: Any) -> None:
        self.callbacks += 1
        future.result().get_result_async().add_done_callback(self._finished)

    def _finished(self, future: Any) -> None:
        self.callbacks += 1
        self._idle = True
        self._left -= 1
        if not self._left:
            self._done.publish(UInt8(data=0))


def ping() -> None:
    """An executable that spins the pinging node of the ping-pong game."""
    _spin("Ping")


def pong() -> None:
    """An executable that spins the answering node."""
    _spin("Pong")


def _spin(name: str) -> None:
    import ping_pong

    rclpy.init()
    node = getattr(ping_pong, name)()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def serve() -> None:
    """An executable that answers calls."""
    rclpy.init()
    node = Node("server")
    node.create_service(Trigger, "call", lambda request, response: response)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass


def call() -> None:
    """An executable that calls from its main, while a thread of its own spins."""
    rclpy.init()
    node = Node("caller")
    calls = node.declare_parameter("calls", 1).value
    done = node.create_publisher(UInt8, "/caller/done", 10)
    client = node.create_client(Trigger, "call")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    client.wait_for_service()
    request = Trigger.Request()
    for _ in range(calls):
        client.call(request)
    done.publish(UInt8(data=0))
