"""Timers on every clock, guard conditions, and what clocks show."""

from __future__ import annotations

from typing import Any

import pytest
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time

pytestmark = pytest.mark.ros
S = 1_000_000_000


def test_every_clock_shows_simulated_time(simulate: Any) -> None:
    seen: list[int] = []

    class Clocks(Node):
        def __init__(self) -> None:
            super().__init__("clocks")
            self.create_timer(1.5, self.tick)

        def tick(self) -> None:
            seen.append(self.get_clock().now().nanoseconds)
            for kind in (ClockType.ROS_TIME, ClockType.SYSTEM_TIME, ClockType.STEADY_TIME):
                seen.append(Clock(clock_type=kind).now().nanoseconds)

    simulate(Clocks, duration=2, job={"start": "100s"})
    assert seen == [101_500_000_000] * 4


def test_use_sim_time_changes_nothing_but_the_flag(simulate: Any) -> None:
    from rsltrace import NodeSpec

    seen: list[Any] = []

    class Sim(Node):
        def __init__(self) -> None:
            super().__init__("sim")
            self.create_timer(
                1.0, lambda: seen.append((self.get_clock().ros_time_is_active, self.now()))
            )

        def now(self) -> int:
            return int(self.get_clock().now().nanoseconds)

    simulate(NodeSpec(node=Sim, parameters={"use_sim_time": True}), duration=1)
    assert seen == [(True, S)]


def test_timers_on_each_kind_of_clock_fire_on_time(simulate: Any) -> None:
    seen: list[tuple[str, int]] = []

    class Timers(Node):
        def __init__(self) -> None:
            super().__init__("timers")
            for kind in ("SYSTEM_TIME", "STEADY_TIME", "ROS_TIME"):
                clock = Clock(clock_type=getattr(ClockType, kind))
                self.create_timer(1.0, lambda k=kind: seen.append((k, self.now())), clock=clock)

        def now(self) -> int:
            return int(self.get_clock().now().nanoseconds) // S

    simulate(Timers, duration=2)
    kinds = ["SYSTEM_TIME", "STEADY_TIME", "ROS_TIME"]
    assert seen == [(kind, second) for second in (1, 2) for kind in kinds]


def test_cancel_reset_and_change_of_period(simulate: Any) -> None:
    seen: list[float] = []

    class Changing(Node):
        def __init__(self) -> None:
            super().__init__("changing")
            self.timer = self.create_timer(1.0, self.tick)
            self.idle = self.create_timer(1.0, lambda: seen.append(-1.0), autostart=False)
            self.create_timer(2.5, self.middle)

        def tick(self) -> None:
            seen.append(self.get_clock().now().nanoseconds / S)
            if len(seen) == 1:
                assert self.timer.time_until_next_call() == S
                assert self.timer.time_since_last_call() == 0
            if len(seen) == 2:
                self.timer.cancel()
                assert self.timer.is_canceled()
                assert self.timer.time_until_next_call() is None
                with pytest.raises(RuntimeError, match="failed to call timer: timer is canceled"):
                    self.timer.handle.call_timer()
                with pytest.raises(RuntimeError, match="failed to create timer: timer period must"):
                    self.create_timer(-1.0, self.tick)

        def middle(self) -> None:
            if len(seen) == 2:
                self.timer.timer_period_ns = S // 2
                self.timer.reset()

    simulate(Changing, duration=5)
    assert seen == [1.0, 2.0, 3.0, 3.5, 4.0, 4.5, 5.0]


def test_a_timer_made_in_a_callback_fires_one_period_later(simulate: Any) -> None:
    seen: list[float] = []

    class Maker(Node):
        def __init__(self) -> None:
            super().__init__("maker")
            self.once = self.create_timer(1.0, self.make)

        def make(self) -> None:
            self.destroy_timer(self.once)
            self.create_timer(0.4, lambda: seen.append(self.get_clock().now().nanoseconds / S))

    simulate(Maker, duration=2)
    assert seen == [1.4, 1.8]


def test_construct_time_makes_overdue_timers_fire_once(simulate: Any) -> None:
    seen: list[float] = []
    jumps: list[int] = []

    class Early(Node):
        def __init__(self) -> None:
            super().__init__("early")
            self.create_timer(0.7, lambda: seen.append(self.get_clock().now().nanoseconds / S))
            self.handle_ = self.get_clock().create_jump_callback(
                JumpThreshold(min_forward=Duration(seconds=1), min_backward=None),
                post_callback=lambda jump: jumps.append(jump.delta.nanoseconds),
            )

    simulate(Early, duration=1.5, job={"construct_time": "0s", "start": "10s"})
    assert seen == [10.0, 10.5, 11.2]
    assert jumps == [10 * S]


def test_guard_conditions_merge_triggers(simulate: Any) -> None:
    seen: list[int] = []

    class Guarded(Node):
        def __init__(self) -> None:
            super().__init__("guarded")
            self.guard = self.create_guard_condition(lambda: seen.append(self.ticks))
            self.ticks = 0
            self.create_timer(1.0, self.tick)
            self.guard.trigger()

        def tick(self) -> None:
            self.ticks += 1
            self.guard.trigger()
            self.guard.trigger()

    simulate(Guarded, duration=2)
    assert seen == [0, 1, 2]


def test_throttled_logs_follow_simulated_time(simulate: Any) -> None:
    class Chatty(Node):
        def __init__(self) -> None:
            super().__init__("chatty")
            self.create_timer(0.5, self.tick)

        def tick(self) -> None:
            stamp = self.get_clock().now().nanoseconds // 10**8
            self.get_logger().info(f"at {stamp}", throttle_duration_sec=2.0)
            self.get_logger().get_child("part").debug("hidden")

    recorded = simulate(Chatty, duration=5)
    assert recorded.logs() == ["at 20", "at 40"]


def test_times_compare_with_clock_readings(simulate: Any) -> None:
    seen: list[bool] = []

    class Compare(Node):
        def __init__(self) -> None:
            super().__init__("compare")
            self.since = self.get_clock().now()
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            now = self.get_clock().now()
            seen.append(now - self.since == Duration(seconds=1))
            seen.append(now > Time(seconds=0, clock_type=ClockType.ROS_TIME))

    simulate(Compare, duration=1)
    assert seen == [True, True]
