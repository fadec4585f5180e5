"""A robot's pipeline of five topics, and slower work beside it, all on one executor."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node
from std_msgs.msg import UInt64

MS = 10_000
"""Rounds of ``work`` that take about a millisecond."""


def work(rounds: int) -> int:
    """Keep the processor busy. The rounds are counted: how long they take is the machine's."""
    value = 1
    for _ in range(rounds):
        value = value * 6364136223846793005 + 1442695040888963407 & 0xFFFFFFFFFFFFFFFF
    return value


class Stage(Node):
    """Takes a topic, works on it, and publishes the next one."""

    def __init__(self, name: str, source: str, target: str, ms: float) -> None:
        super().__init__(name)
        self.rounds = int(ms * MS)
        self.out = self.create_publisher(UInt64, target, 10) if target else None
        self.create_subscription(UInt64, source, self.take, 10)

    def take(self, message: UInt64) -> None:
        work(self.rounds)
        if self.out is not None:
            self.out.publish(message)


class Source(Node):
    """Works in a timer, and publishes what comes of it."""

    def __init__(self, name: str, period: float, target: str, ms: float) -> None:
        super().__init__(name)
        self.rounds, self.count = int(ms * MS), 0
        self.out = self.create_publisher(UInt64, target, 10)
        self.create_timer(period, self.tick)

    def tick(self) -> None:
        work(self.rounds)
        self.count += 1
        self.out.publish(UInt64(data=self.count))


def robot() -> list[Node]:
    """Make all nodes; they share an executor."""
    makers: list[Callable[[], Node]] = [
        lambda: Source("diagnostics", 0.5, "/status", 12),
        lambda: Stage("log", "/status", "", 6),
        lambda: Source("mapper", 0.2, "/map", 9),
        lambda: Stage("map_server", "/map", "", 6),
        lambda: Source("camera", 0.05, "/image", 1),
        lambda: Stage("detector", "/image", "/objects", 6),
        lambda: Stage("tracker", "/objects", "/tracks", 3),
        lambda: Stage("planner", "/tracks", "/plan", 4),
        lambda: Stage("controller", "/plan", "/cmd", 1),
        lambda: Stage("driver", "/cmd", "", 1),
    ]
    return [make() for make in makers]
