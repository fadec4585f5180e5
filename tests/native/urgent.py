"""Nodes for native runs with priorities: everything is ready before the first callback runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

RAN: list[str] = []


def finished(progress: Any) -> bool:
    """End a run when all that is to run has run."""
    return len(RAN) >= 5


class Backlog(Node):
    """Three timers, the slowest created first, each for one call; the last two send, and hear."""

    def __init__(self) -> None:
        super().__init__("backlog")
        self.mine = {name: self.create_publisher(String, name, 10) for name in ("slow", "fast")}
        for name in self.mine:
            self.create_subscription(String, name, self.hear, 10)
        for name, period_ms in (("slow", 30), ("middle", 20), ("fast", 10)):
            self.once(period_ms, self.sender(name))
        time.sleep(0.1)

    def once(self, period_ms: int, callback: Callable[[], None]) -> None:
        def call() -> None:
            timer.cancel()
            callback()

        call.__qualname__ = callback.__qualname__
        timer = self.create_timer(period_ms / 1000, call)

    def sender(self, name: str) -> Callable[[], None]:
        def send() -> None:
            RAN.append(name)
            if name in self.mine:
                self.mine[name].publish(String())

        send.__qualname__ = name
        return send

    def hear(self, message: String) -> None:
        RAN.append("heard")
