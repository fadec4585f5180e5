"""Callback groups of one's own, which count, limit and alternate. What came of it goes to standard
output, as JSON. Run by Python (over DDS) and by rsltrace."""

from __future__ import annotations

import itertools
import json
import threading
import time
from collections import Counter
from typing import Any

import rclpy
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger

RESULTS: dict[str, Any] = {}


class Counting(CallbackGroup):
    """Lets everything run, and counts."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def can_execute(self, entity: Any) -> bool:
        return True

    def beginning_execution(self, entity: Any) -> bool:
        self.counts[f"{type(entity).__name__} begins"] += 1
        return True

    def ending_execution(self, entity: Any) -> None:
        self.counts[f"{type(entity).__name__} ends"] += 1


class Limiting(CallbackGroup):
    """Lets two run at once."""

    def __init__(self) -> None:
        super().__init__()
        self.lock = threading.Lock()
        self.running = self.most = 0

    def can_execute(self, entity: Any) -> bool:
        return self.running < 2

    def beginning_execution(self, entity: Any) -> bool:
        with self.lock:
            if self.running >= 2:
                return False
            self.running += 1
            self.most = max(self.most, self.running)
            return True

    def ending_execution(self, entity: Any) -> None:
        with self.lock:
            self.running -= 1


class Alternating(MutuallyExclusiveCallbackGroup):
    """Never lets the same run twice in a row. It is of rclpy's own kind otherwise."""

    def __init__(self) -> None:
        super().__init__()
        self.last: Any = None

    def can_execute(self, entity: Any) -> bool:
        return entity is not self.last and bool(super().can_execute(entity))

    def beginning_execution(self, entity: Any) -> bool:
        if entity is self.last or not super().beginning_execution(entity):
            return False
        self.last = entity
        return True


class Gate(CallbackGroup):
    """Lets nothing run until somebody opens it."""

    open = False

    def can_execute(self, entity: Any) -> bool:
        return self.open

    def beginning_execution(self, entity: Any) -> bool:
        return self.open

    def ending_execution(self, entity: Any) -> None:
        pass


def spin(executor: Executor, node: Node, until: Any) -> None:
    executor.add_node(node)
    give_up = time.monotonic() + 240
    while not until() and time.monotonic() < give_up:
        executor.spin_once(timeout_sec=0.1)
    executor.remove_node(node)


def count() -> None:
    node = Node("counted")
    group = Counting()
    calls: Counter[str] = Counter()

    def serve(request: Any, response: Any) -> Any:
        calls["service"] += 1
        return response

    async def soon() -> None:
        calls["coroutine"] += 1

    latched = QoSProfile(depth=1)
    publisher = node.create_publisher(UInt64, "counted", latched)
    node.create_subscription(
        UInt64, "counted", lambda m: calls.update(message=1), latched, callback_group=group
    )
    node.create_service(Trigger, "serve", serve, callback_group=group)
    client = node.create_client(Trigger, "serve", callback_group=group)
    guard = node.create_guard_condition(soon, callback_group=group)
    timer = node.create_timer(0.05, lambda: tick(), callback_group=group)
    futures: list[Any] = []

    def tick() -> None:
        if not client.service_is_ready() or not publisher.get_subscription_count():
            group.counts.clear()
            return
        calls["timer"] += 1
        timer.cancel()
        publisher.publish(UInt64(data=1))
        futures.append(client.call_async(Trigger.Request()))
        guard.trigger()

    wanted = {"timer": 1, "message": 1, "service": 1, "coroutine": 1}
    spin(SingleThreadedExecutor(), node, lambda: calls == wanted and futures[0].done())
    group.counts["Timer begins"] = group.counts["Timer ends"]  # those that waited for discovery
    RESULTS["count"] = dict(sorted(group.counts.items())), dict(sorted(calls.items()))
    node.destroy_node()


def limit() -> None:
    node = Node("limited")
    group = Limiting()
    done: list[int] = []

    def make(number: int) -> None:
        def work() -> None:
            timer.cancel()
            time.sleep(0.2)
            done.append(number)

        timer = node.create_timer(0.05, work, callback_group=group)

    for number in range(5):
        make(number)
    executor = MultiThreadedExecutor(4)
    spin(executor, node, lambda: len(done) == 5)
    RESULTS["limit"] = group.most, sorted(done)
    node.destroy_node()


def alternate() -> None:
    node = Node("alternating")
    group = Alternating()
    order: list[str] = []
    node.create_timer(0.05, lambda: order.append("a"), callback_group=group)
    node.create_timer(0.02, lambda: order.append("b"), callback_group=group)
    spin(SingleThreadedExecutor(), node, lambda: len(order) >= 10)
    RESULTS["alternate"] = set(order[0:10:2]) | set(order[1:10:2]) == {"a", "b"} and all(
        one != other for one, other in itertools.pairwise(order)
    )
    node.destroy_node()


def gate() -> None:
    node = Node("gated")
    group = Gate()
    order: list[str] = []

    def let_in() -> None:
        order.append("open" if not group.open else "already open")
        group.open = True
        opener.cancel()

    node.create_timer(0.02, lambda: order.append("through"), callback_group=group)
    opener = node.create_timer(0.3, let_in)
    spin(SingleThreadedExecutor(), node, lambda: len(order) >= 3)
    RESULTS["gate"] = order[:3]
    node.destroy_node()


if __name__ == "__main__":  # the groups are imported, too, where nothing is to go over DDS
    rclpy.init()
    for scenario in (count, limit, alternate, gate):
        scenario()
    rclpy.shutdown()
    print(json.dumps(RESULTS))
