"""Clocks that are wrong: offset, drift, jumps given and drawn."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from statistics import fmean
from typing import Any

import pytest

from rsltrace.simulation.chance.stream import ClockModel, RandomStream, SkewedClock

MS = 1_000_000
S = 1_000_000_000


def clock(model: ClockModel, start_ns: int = 0, name: str = "c") -> SkewedClock:
    return SkewedClock(model, RandomStream(1, name), start_ns)


def test_offset_drift_and_jumps_add_up() -> None:
    model = ClockModel(-20 * MS, Fraction(50, 10**6), ((S, 100 * MS), (2 * S, -S)))
    wrong = clock(model, 100 * S)
    assert wrong.shows(100 * S) == 100 * S - 20 * MS
    assert wrong.shows(101 * S - 1) == 101 * S - 1 - 20 * MS + 49_999
    assert wrong.shows(101 * S) == 101 * S - 20 * MS + 50_000 + 100 * MS
    assert wrong.shows(102 * S) == 102 * S - 20 * MS + 100_000 - 900 * MS
    assert clock(ClockModel(-S)).shows(5) == 0  # a time is never negative


def test_random_jumps_are_a_poisson_process_of_uniform_sizes() -> None:
    wrong = clock(ClockModel(random_every_ns=S, random_most_ns=50 * MS))
    end = 20_000
    errors = [wrong.shows(t * S) - t * S for t in range(end)]
    jumps = wrong._drawn_at
    count = sum(at < end * S for at in jumps)
    assert abs(count - end) < 4 * math.sqrt(end)
    sizes = [b - a for a, b in zip(wrong._drawn_sum, wrong._drawn_sum[1:], strict=False)]
    assert all(abs(size) <= 50 * MS for size in sizes)
    assert abs(fmean(sizes)) < 4 * 50 * MS / math.sqrt(3 * len(sizes))
    again = clock(ClockModel(random_every_ns=S, random_most_ns=50 * MS))
    assert [again.shows(t * S) - t * S for t in reversed(range(end))] == errors[::-1]


@pytest.mark.ros
def test_each_node_has_its_own_clock(simulate: Callable[..., Any]) -> None:
    pytest.importorskip("rclpy")
    import time

    from rclpy.clock import Clock
    from rclpy.node import Node

    seen: dict[str, list[Any]] = {}

    class Looker(Node):  # type: ignore[misc]
        def __init__(self, name: str) -> None:
            super().__init__(name)
            self.create_timer(1.0, self.look)

        def look(self) -> None:
            shown = self.get_clock().now().nanoseconds
            assert Clock().now().nanoseconds == shown
            stamp = self.get_clock().now().to_msg()
            assert stamp.sec * S + stamp.nanosec == shown
            seen.setdefault(self.get_name(), []).append((shown, time.time_ns()))

    clocks = [
        {"node": "/ahead", "offset": "20ms", "jumps": [{"at": "1.5s", "by": "-1.1s"}]},
        {"node": "/dri*", "drift": "1000ppm"},
    ]
    simulate(
        lambda: [Looker("ahead"), Looker("drifts"), Looker("right")],
        duration=2.0,
        job={"clocks": clocks, "start": "100s"},
    )
    assert [shown for shown, _ in seen["right"]] == [101 * S, 102 * S]
    assert [shown for shown, _ in seen["ahead"]] == [101 * S + 20 * MS, 100 * S + 920 * MS]
    assert [shown for shown, _ in seen["drifts"]] == [101 * S + MS, 102 * S + 2 * MS]
    for name in seen:  # Python's own clock is the same computer's
        assert [shown for shown, _ in seen[name]] == [python for _, python in seen[name]]


def test_each_jump_is_told_once_whenever_it_is_asked_for() -> None:
    wrong = clock(ClockModel(random_every_ns=S, random_most_ns=50 * MS))
    told = [wrong.set_since(t * 7 * S) for t in range(100)]
    assert sum(told) == wrong.shows(99 * 7 * S) - 99 * 7 * S
    assert wrong.set_since(99 * 7 * S) == 0
    assert wrong.set_since(0) == 0  # time has gone back: nothing is told twice
    assert clock(ClockModel(offset_ns=S)).set_since(9 * S) == 0
