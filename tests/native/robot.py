"""Nodes of all kinds of callbacks, which number what they send."""

import os
import threading
import time
from collections import Counter as Counts
from pathlib import Path
from typing import Any

import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import String, UInt64
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

DONE: set[str] = set()
"""Who has published on /done."""
HEARD = Counts({"/numbers": 0, "/same": 0})
"""How many messages listeners have got."""


def finished(progress: Any) -> bool:
    """End a run when everybody has done what they do once, and listeners have heard a lot."""
    return min(HEARD.values()) > 50 and {"asker", "nested"} <= DONE


class Talker(Node):
    """Sends numbers on /numbers, and always the same text on /same."""

    def __init__(self, offset: int = 0) -> None:
        super().__init__(f"talker{offset}")
        self.numbers = self.create_publisher(UInt64, "/numbers", 1000)
        self.same = self.create_publisher(String, "/same", 1000)
        self.count = offset
        self.create_timer(self.declare_parameter("period", 0.02).value, self.on_timer)

    def on_timer(self) -> None:
        self.numbers.publish(UInt64(data=self.count))
        self.same.publish(String(data="the same"))
        self.count += 1


class Counter(Node):
    """Counts on from ``first`` once somebody hears, then says that all is over."""

    def __init__(self, first: int = 0) -> None:
        super().__init__("counter")
        self.first = first
        self.numbers = self.create_publisher(UInt64, "/numbers", 50)
        self.over = self.create_publisher(String, "/over", 10)
        self.create_subscription(UInt64, "/echo", self.on_echo, 50)
        self.timer = self.create_timer(0.05, self.on_timer)

    def on_timer(self) -> None:
        if self.numbers.get_subscription_count():
            self.timer.cancel()
            self.numbers.publish(UInt64(data=self.first))

    def on_echo(self, message: UInt64) -> None:
        if message.data >= self.first + 20:
            self.over.publish(String())
        else:
            self.numbers.publish(UInt64(data=message.data + 1))


class Listener(Node):
    """Sends on /echo what it hears, and says so."""

    def __init__(self) -> None:
        super().__init__("listener")
        self.echo = self.create_publisher(UInt64, "/echo", 1000)
        self.create_subscription(UInt64, "/numbers", self.on_number, 1000)
        self.create_subscription(String, "/same", self.on_same, 1000)

    def on_number(self, message: UInt64) -> None:
        HEARD["/numbers"] += 1
        self.echo.publish(message)
        if message.data == 3:
            self.get_logger().warning("three")

    def on_same(self, message: String) -> None:
        HEARD["/same"] += 1


class LateListener(Listener):
    """Takes long to construct."""

    def __init__(self) -> None:
        time.sleep(8)
        super().__init__()


class Server(Node):
    """Serves /ask, and an action."""

    def __init__(self) -> None:
        super().__init__("server")
        self.create_service(Trigger, "/ask", self.on_ask)
        group = ReentrantCallbackGroup()
        ActionServer(self, Fibonacci, "/count", self.on_goal, callback_group=group)

    def on_ask(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = "yes"
        return response

    def on_goal(self, goal: Any) -> Fibonacci.Result:
        goal.publish_feedback(Fibonacci.Feedback(sequence=[1]))
        goal.succeed()
        return Fibonacci.Result(sequence=[1, 1, 2])


ASKED_AGAIN_NS = 20 * 10**9
"""A server drops its answer if it has not found the client within a tenth of a second."""


class NotingClient(ActionClient):
    """Takes nothing between a request that leaves and the note of it: rclpy's, on threads, ignores
    a response to what is not noted."""

    def __init__(self, *words: Any, **more: Any) -> None:
        self.noting = threading.Lock()
        super().__init__(*words, **more)

    def send_goal_async(self, *words: Any, **more: Any) -> Any:
        with self.noting:
            return super().send_goal_async(*words, **more)

    def _get_result_async(self, goal: Any) -> Any:
        with self.noting:
            return super()._get_result_async(goal)

    def take_data(self) -> Any:
        with self.noting:
            return super().take_data()


class Asker(Node):
    """Asks until there is an answer, sends a goal, and then says that all is done."""

    def __init__(self) -> None:
        super().__init__("asker")
        group = ReentrantCallbackGroup()  # its callback awaits what others of the node bring
        self.count = NotingClient(self, Fibonacci, "/count", callback_group=group)
        # Made after the other: who answers it has found both.
        self.ask = self.create_client(Trigger, "/ask", callback_group=group)
        self.asks_at_ns = 0
        self.done = self.create_publisher(String, "/done", 10)
        self.timer = self.create_timer(0.05, self.on_timer, callback_group=group)

    async def on_timer(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        is_ready = self.ask.service_is_ready() and self.count.server_is_ready()
        if not is_ready or now_ns < self.asks_at_ns:
            return
        self.asks_at_ns = now_ns + ASKED_AGAIN_NS
        answer = await self.ask.call_async(Trigger.Request())
        if self.timer.is_canceled():
            return
        self.timer.cancel()
        goal = await self.count.send_goal_async(Fibonacci.Goal(order=3))
        result = await goal.get_result_async()
        DONE.add("asker")
        self.done.publish(String(data=f"{answer.message} {list(result.result.sequence)}"))


class Raising(Node):
    """Raises in its third callback."""

    def __init__(self) -> None:
        super().__init__("raising")
        self.count = 0
        self.create_timer(0.02, self.on_timer)

    def on_timer(self) -> None:
        self.count += 1
        if self.count == 3:
            raise ValueError("the third")


class Stuck(Node):
    """Has a callback that does not come back."""

    def __init__(self) -> None:
        super().__init__("stuck")
        self.create_timer(0.02, self.on_timer)

    def on_timer(self) -> None:
        Path(os.environ["STUCK"]).touch()
        threading.Event().wait()


class Nested(Node):
    """Spins another node within a callback."""

    def __init__(self) -> None:
        super().__init__("nested")
        self.done = self.create_publisher(String, "/done", 10)
        self.inner = rclpy.create_node("inner")
        self.asks = self.inner.create_client(Trigger, "/ask")
        self.rate = self.create_rate(1.0)
        self.timer = self.create_timer(0.05, self.on_timer)

    def on_timer(self) -> None:
        if self.asks.service_is_ready():
            self.timer.cancel()
            done = False
            while not done:
                future = self.asks.call_async(Trigger.Request())
                rclpy.spin_until_future_complete(self.inner, future, None, ASKED_AGAIN_NS / 1e9)
                done = future.done()
            DONE.add("nested")
            self.done.publish(String(data=future.result().message))
