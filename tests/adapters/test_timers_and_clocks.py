"""Timers on every clock, guard conditions, and what clocks show."""

from __future__ import annotations

from typing import Any

import pytest
from rclpy.clock import Clock, ClockType, JumpThreshold, ROSClock
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time
from rclpy.time_source import TimeSource

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
    """A native run logs the first one: only /clock starts near 0, where rclpy's throttle began."""

    class Chatty(Node):
        def __init__(self) -> None:
            super().__init__("chatty")
            self.own = ROSClock()
            self.own._set_ros_time_is_active(True)
            self.create_timer(0.5, self.tick)

        def tick(self) -> None:
            now = self.get_clock().now()
            stamp = now.nanoseconds // 10**8
            self.own.set_ros_time_override(now)
            self.get_logger().info(f"at {stamp}", throttle_duration_sec=2.0)
            self.get_logger().info(
                f"source at {stamp}", throttle_duration_sec=2.0, throttle_time_source_type=self.own
            )
            self.get_logger().get_child("part").debug("hidden")

    recorded = simulate(Chatty, duration=5)
    assert recorded.logs() == ["at 5", "source at 20", "at 25", "source at 40", "at 45"]


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


def test_user_code_sets_the_time_of_a_clock_of_its_own(simulate: Any) -> None:
    seen: list[Any] = []

    class Setting(Node):
        def __init__(self) -> None:
            super().__init__("setting")
            self.own = ROSClock()
            threshold = JumpThreshold(
                min_forward=Duration(nanoseconds=1), min_backward=None, on_clock_change=True
            )
            self.jumps = self.own.create_jump_callback(
                threshold, post_callback=lambda jump: seen.append(jump.delta.nanoseconds)
            )
            self.create_timer(0.5, self.fired, clock=self.own)
            self.set(5.0)
            self.own._set_ros_time_is_active(True)
            self.create_timer(1.0, self.advance)

        def set(self, seconds: float) -> None:
            self.own.set_ros_time_override(Time(seconds=seconds, clock_type=ClockType.ROS_TIME))

        def now(self, clock: Clock) -> float:
            return clock.now().nanoseconds / S

        def advance(self) -> None:
            self.set(self.now(self.own) + 0.25)

        def fired(self) -> None:
            seen.append((self.now(self.own), self.now(self.get_clock())))

    simulate(Setting, duration=4)
    quarter = S // 4
    assert seen == [0, quarter, quarter, (5.5, 2.0), quarter, quarter, (6.0, 4.0)]


def test_a_clock_attached_to_a_time_source_shows_what_its_node_shows(simulate: Any) -> None:
    seen: list[int] = []

    class Attaching(Node):
        def __init__(self) -> None:
            super().__init__("attaching")
            own = ROSClock()
            source = TimeSource(node=self)
            source.attach_clock(own)
            source.ros_time_is_active = True
            self.create_timer(1.0, lambda: seen.append(own.now().nanoseconds), clock=own)

    simulate(Attaching, duration=2)
    assert seen == [S, 2 * S]


def test_only_ros_clocks_have_an_override(simulate: Any) -> None:
    class Steady(Node):
        def __init__(self) -> None:
            super().__init__("steady")
            handle = Clock(clock_type=ClockType.STEADY_TIME).handle
            with pytest.raises(RuntimeError, match="Clock is not of type RCL_ROS_TIME, cannot en"):
                handle.set_ros_time_override_is_enabled(True)
            with pytest.raises(RuntimeError, match="Clock is not of type RCL_ROS_TIME, cannot qu"):
                handle.get_ros_time_override_is_enabled()

    simulate(Steady, duration=1)


def test_timers_without_a_period_run_every_millisecond(simulate: Any) -> None:
    """ROS runs them whenever the executor comes to them; time has to go on."""
    seen: list[float] = []

    class Restless(Node):
        def __init__(self) -> None:
            super().__init__("restless")
            self.timer = self.create_timer(0.0, self.tick)
            assert self.timer.timer_period_ns == 0

        def tick(self) -> None:
            seen.append(self.get_clock().now().nanoseconds / S)
            self.timer.reset()
            if len(seen) == 3:
                self.timer.timer_period_ns = -5

    simulate(Restless, duration="4ms")
    assert seen == [0.0, 0.001, 0.002, 0.003, 0.004]


def test_periods_have_64_bits(simulate: Any) -> None:
    class Eternal(Node):
        def __init__(self) -> None:
            super().__init__("eternal")
            with pytest.raises(TypeError, match="incompatible constructor arguments"):
                self.create_timer(1e10, lambda: None)
            timer = self.create_timer(1.0, lambda: None)
            with pytest.raises(TypeError, match="incompatible function arguments"):
                timer.timer_period_ns = 1 << 63

    simulate(Eternal, duration=1)
