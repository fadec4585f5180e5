"""Nodes and mains for ``graphs.py`` and ``usual.py``: what users bring, and as little of their own
work as can be.

``callbacks`` of a node counts what a figure is divided by: logs, goals, sets, images, calls.
"""

from __future__ import annotations

import array
import os
import threading
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import UInt8
from std_srvs.srv import Trigger

FEEDBACKS = 3

EACH = 100
"""Logs and sets of a parameter in one callback."""

IMAGE_WIDTH, IMAGE_HEIGHT = 2000, 1000
IMAGE_BYTES = 3 * IMAGE_WIDTH * IMAGE_HEIGHT


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


class Logger(Node):
    """Logs at one line of its code. Parameter ``period``: seconds between its callbacks."""

    def __init__(self) -> None:
        super().__init__("logger")
        self.callbacks = 0
        self.create_timer(self.declare_parameter("period", 1e-6).value, self._log)

    def _log(self) -> None:
        logger = self.get_logger()
        for _ in range(EACH):
            self.callbacks += 1
            logger.info(f"record {self.callbacks}")


class Setter(Node):
    """Sets a parameter that it declares, and checks it. Parameter ``period`` as above."""

    def __init__(self) -> None:
        super().__init__("setter")
        self.callbacks = 0
        self.declare_parameter("gain", 0)
        self.add_on_set_parameters_callback(self._check)
        self.create_timer(self.declare_parameter("period", 1e-6).value, self._set)

    def _check(self, parameters: list[Any]) -> Any:
        from rcl_interfaces.msg import SetParametersResult

        return SetParametersResult(successful=parameters[0].value >= 0)

    def _set(self) -> None:
        for _ in range(EACH):
            self.callbacks += 1
            self.set_parameters([Parameter("gain", value=self.callbacks)])


class GoalAsker(Asker):
    """An action client whose ``callbacks`` are the goals that are done."""

    def __init__(self) -> None:
        super().__init__()
        self.goals = 0

    def _finished(self, future: Any) -> None:
        super()._finished(future)
        self.goals += 1


class Camera(Node):
    """Publishes an image of 6 MB with every tick. Parameter ``period`` as above."""

    def __init__(self) -> None:
        super().__init__("camera")
        self.callbacks = 0
        self._image = image()
        self._publisher = self.create_publisher(type(self._image), "image", 1)
        self.create_timer(self.declare_parameter("period", 1e-6).value, self._publish)

    def _publish(self) -> None:
        self.callbacks += 1
        self._publisher.publish(self._image)


class Display(Node):
    """Takes images. Over DDS they may be lost: these are what is counted."""

    def __init__(self, name: str = "display") -> None:
        from sensor_msgs.msg import Image

        super().__init__(name)
        self.callbacks = 0
        self.create_subscription(Image, "image", self._show, 1)

    def _show(self, message: Any) -> None:
        self.callbacks += 1


class Counter(Node):
    """Publishes a number every millisecond, for small messages in a file."""

    def __init__(self) -> None:
        super().__init__("counter")
        self._publisher = self.create_publisher(UInt8, "count", 10)
        self.create_subscription(UInt8, "count", lambda message: None, 10)
        self.create_timer(0.001, lambda: self._publisher.publish(UInt8()))


class Idle(Node):
    """The least a node can do: one timer, a topic."""

    def __init__(self) -> None:
        super().__init__("idle")
        self._publisher = self.create_publisher(UInt8, "beat", 10)
        self.create_timer(0.1, lambda: self._publisher.publish(UInt8()))


def image() -> Any:
    """Return an image whose bytes do not get smaller."""
    from sensor_msgs.msg import Image

    pixels = array.array("B", os.urandom(IMAGE_BYTES))
    return Image(
        height=IMAGE_HEIGHT,
        width=IMAGE_WIDTH,
        encoding="rgb8",
        step=3 * IMAGE_WIDTH,
        data=pixels,
    )


def log_nodes() -> list[Any]:
    """Return the nodes of the case ``logs``."""
    return [Logger()]


def set_nodes() -> list[Any]:
    """Return the nodes of the case ``parameters``."""
    return [Setter()]


def goal_nodes() -> list[Any]:
    """Return the nodes of the case ``goals``."""
    return [GoalAsker(), Worker()]


def image_nodes() -> list[Any]:
    """Return the nodes of the case ``images``."""
    return [Camera(), Display("left"), Display("right")]


def ping() -> None:
    """An executable that spins the pinging node of the ping-pong game."""
    _spin("Ping", rclpy.spin)


def pong() -> None:
    """An executable that spins the answering node."""
    _spin("Pong", rclpy.spin)


def ping_once() -> None:
    """An executable that spins the pinging node by ``spin_once``."""
    _spin("Ping", _spin_once)


def pong_once() -> None:
    """An executable that spins the answering node by ``spin_once``."""
    _spin("Pong", _spin_once)


def _spin_once(node: Node) -> None:
    while rclpy.ok():
        rclpy.spin_once(node)


def _spin(name: str, spin: Callable[[Node], None]) -> None:
    import ping_pong

    rclpy.init()
    node = getattr(ping_pong, name)()
    try:
        spin(node)
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
    node.callbacks = 0
    calls = node.declare_parameter("calls", 0).value
    done = node.create_publisher(UInt8, "/caller/done", 10)
    client = node.create_client(Trigger, "call")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    client.wait_for_service()
    request = Trigger.Request()
    while node.callbacks < calls or not calls:
        client.call(request)
        node.callbacks += 1
    done.publish(UInt8(data=0))


def call_and_spin() -> None:
    """An executable that calls with ``spin_until_future_complete``, as most do."""
    rclpy.init()
    node = Node("caller")
    node.callbacks = 0
    calls = node.declare_parameter("calls", 0).value
    done = node.create_publisher(UInt8, "/caller/done", 10)
    client = node.create_client(Trigger, "call")
    client.wait_for_service()
    request = Trigger.Request()
    while node.callbacks < calls or not calls:
        rclpy.spin_until_future_complete(node, client.call_async(request))
        node.callbacks += 1
    done.publish(UInt8(data=0))
