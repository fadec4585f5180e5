"""Waiting for what is left until a time: rounding leaves 1e-17 s of it, and time has to pass."""

from __future__ import annotations

import queue
import select
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from rclpy.node import Node

from rsltrace import NodeSpec
from rsltrace.trace.model.texts import waiting_ns

pytestmark = pytest.mark.ros

TINY = 1e-17


def waits() -> dict[str, Callable[[float], object]]:
    never = threading.Event()
    taken = threading.Lock()
    taken.acquire()
    idle = threading.Thread(target=never.wait, daemon=True)
    idle.start()
    empty: queue.SimpleQueue[int] = queue.SimpleQueue()

    def get(timeout: float) -> None:
        with pytest.raises(queue.Empty):
            empty.get(timeout=timeout)

    return {
        "sleep": time.sleep,
        "event": never.wait,
        "lock": lambda timeout: taken.acquire(timeout=timeout),
        "join": idle.join,
        "queue": get,
        "select": lambda timeout: select.select([], [], [], timeout),
    }


def test_every_wait_lets_time_pass(simulate: Any) -> None:
    shown_ns: dict[str, int] = {}

    def main() -> None:
        rclpy.init()
        clock = Node("node").get_clock()
        for name, wait in waits().items():
            before = clock.now()
            wait(TINY)
            shown_ns[name] = (clock.now() - before).nanoseconds

    simulate(NodeSpec(main=main), duration=1)
    assert shown_ns == dict.fromkeys(waits(), 1)


def test_a_semaphore_is_given_up(simulate: Any) -> None:
    """0.1 s after 0.2 s is 0.30000000000000004 s, which is later than 0.3 s for ever."""
    given: list[bool] = []

    def main() -> None:
        semaphore = threading.Semaphore(0)
        given.extend(semaphore.acquire(timeout=0.1) for _ in range(30))

    recorded = simulate(NodeSpec(main=main), duration=10)
    assert given == [False] * 30
    assert recorded.result.events < 1000


def test_what_is_left_is_never_nothing() -> None:
    assert [waiting_ns(s) for s in (0.0, TINY, 1e-9, 0.1, 2.5, -TINY, -1.0)] == [
        0,
        1,
        1,
        100_000_000,
        2_500_000_000,
        0,
        -1_000_000_000,
    ]
