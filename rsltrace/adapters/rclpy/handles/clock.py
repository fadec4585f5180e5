"""Clocks: ROS, system and steady time are all simulated time, as the node's clock shows it.

If the job says so, ROS time is that of ``/clock`` or set by hand, by rcl's rules.
"""

from __future__ import annotations

import sys
import weakref
from functools import partial
from typing import Any, Protocol

from rsltrace.adapters.rclpy.concurrency.blocking_calls import SimEvent
from rsltrace.adapters.rclpy.handles.destroyable import Handle


class _TimePoint:
    """The part of ``rcl_time_point_t`` that rclpy reads."""

    __slots__ = ("nanoseconds",)

    def __init__(self, nanoseconds: int) -> None:
        self.nanoseconds = nanoseconds


class ClockFollower(Protocol):
    """Depends on the time of a clock that ``/clock`` drives."""

    def time_changes(self) -> None:
        """ROS time is about to be switched on or off."""

    def time_changed(self, *, switched: bool) -> None:
        """The clock shows another time, or ROS time was switched on or off."""


class ClockHandle(Handle):
    """Stands in for ``_rclpy.Clock``.

    A clock outlives runs (rclpy keeps one in a class attribute), so it asks the boundary for the
    current world; between runs it shows the last simulated time.
    """

    boundary: Any

    def __init__(self, clock_type: Any) -> None:
        super().__init__()
        self.clock_type = clock_type
        self._override = False
        self._set_ns = 0
        self.followers: list[ClockFollower] = []
        self._callbacks: list[tuple[Any, bool, int, int]] = []
        self._owner: str | None = self.boundary.current_node_name()
        self._is_users_own = _caller() != "rclpy.node"
        if clock_type == self.boundary.ClockType.ROS_TIME:
            self.boundary.ros_clocks.append(weakref.ref(self))

    @property
    def follows(self) -> bool:
        """Whether ``/clock`` drives it while ``use_sim_time`` is on, or user code that made it."""
        is_ros = self.clock_type == self.boundary.ClockType.ROS_TIME
        return is_ros and (self._is_users_own or bool(self.boundary.follows(self._owner)))

    @property
    def is_driven(self) -> bool:
        """Whether it shows a time that was set, not simulated time."""
        return self._override and self.follows

    def get_now(self) -> _TimePoint:
        """Return what the node's clock shows; this counts as a reading by user code."""
        return _TimePoint(self._set_ns if self.is_driven else self.boundary.look_ns(self._owner))

    def now_ns(self) -> int:
        """Return what the node's clock shows, without counting as a reading."""
        return self._set_ns if self.is_driven else int(self.boundary.shown_ns(self._owner))

    def _require_ros(self, task: str, what: str) -> None:
        if self.clock_type != self.boundary.ClockType.ROS_TIME:
            reason = f"Clock is not of type RCL_ROS_TIME, cannot {what}."
            raise self.boundary.RCLError(f"failed to {task}: {reason}")

    def get_ros_time_override_is_enabled(self) -> bool:
        """Return whether ``use_sim_time`` is on for this clock."""
        self._require_ros("get ROS time override status", "query override state")
        return self._override

    def set_ros_time_override_is_enabled(self, enabled: bool) -> None:
        self._require_ros("set ROS time override", "enable override")
        if enabled == self._override:
            return
        changes = self.boundary.ClockChange
        change = changes.ROS_TIME_ACTIVATED if enabled else changes.ROS_TIME_DEACTIVATED
        wanted = [entry for entry in self._callbacks if entry[1]]
        for follower in list(self.followers):
            follower.time_changes()
        self._jump(wanted, change, 0, lambda: setattr(self, "_override", enabled))
        for follower in list(self.followers):
            follower.time_changed(switched=True)

    def set_ros_time_override(self, time_point: Any) -> None:
        """Set ROS time, if ``/clock`` or user code drives it."""
        if self._is_users_own and _caller() == "rclpy.time_source":
            self._is_users_own = False  # attached to that of a node
        if not self.follows:
            if self._override:
                self.boundary.note_ignored_time()
            return
        time_ns = time_point.nanoseconds
        if not self._override:
            self._set_ns = time_ns
            return
        delta_ns = time_ns - self._set_ns
        change = self.boundary.ClockChange.ROS_TIME_NO_CHANGE
        self._jump(self._exceeded(delta_ns), change, delta_ns, partial(self._set, time_ns))
        for follower in list(self.followers):
            follower.time_changed(switched=False)

    def _set(self, time_ns: int) -> None:
        self._set_ns = time_ns

    def add_clock_callback(
        self, jump_handle: Any, on_clock_change: bool, min_forward: int, min_backward: int
    ) -> None:
        """Register a jump handle; thresholds in nanoseconds, 0 for none."""
        self._callbacks.append((jump_handle, on_clock_change, min_forward, min_backward))

    def remove_clock_callback(self, jump_handle: Any) -> None:
        self._callbacks = [entry for entry in self._callbacks if entry[0] is not jump_handle]

    def jumped(self, delta_ns: int) -> None:
        """Run the jump callbacks for a jump of simulated time (at the start of the run)."""
        if self.is_driven:
            return
        change = self.boundary.ClockChange
        kind = change.ROS_TIME_NO_CHANGE if self._override else change.SYSTEM_TIME_NO_CHANGE
        self._jump(self._exceeded(delta_ns), kind, delta_ns, lambda: None)

    def _exceeded(self, delta_ns: int) -> list[Any]:
        return [
            entry
            for entry in self._callbacks
            if (delta_ns > 0 and 0 < entry[2] <= delta_ns)
            or (delta_ns < 0 and delta_ns <= entry[3] < 0)
        ]

    def _jump(self, entries: list[Any], change: Any, delta_ns: int, act: Any) -> None:
        for jump_handle, *_ in entries:
            if jump_handle._pre_callback is not None:
                jump_handle._pre_callback()
        act()
        for jump_handle, *_ in entries:
            if jump_handle._post_callback is not None:
                jump_handle._post_callback({"clock_change": change, "delta": delta_ns})


def _caller() -> str:
    """Return the module that uses ``rclpy.clock``."""
    frame = sys._getframe(2)
    while frame.f_back is not None and frame.f_globals.get("__name__") == "rclpy.clock":
        frame = frame.f_back
    return str(frame.f_globals.get("__name__"))


class ClockEventHandle:
    """Stands in for ``_rclpy.ClockEvent``."""

    boundary: Any

    def __init__(self) -> None:
        self._event = SimEvent(self.boundary.runtime, "a time to come (Clock.sleep_until)")

    def set(self) -> None:
        self._event.set()

    def clear(self) -> None:
        self._event.clear()

    def is_set(self) -> bool:
        return self._event.is_set()

    def _wait_until(self, clock: Any, until: Any) -> bool:
        left_ns = until.nanoseconds - clock.now_ns()
        return left_ns <= 0 or self._event.wait_ns(left_ns)

    def wait_until_ros(self, clock: Any, until: Any) -> bool:
        """Wait until a ROS clock, which ``/clock`` may drive, shows a time."""
        while clock.is_driven:
            if clock.now_ns() >= until.nanoseconds:
                return True
            if self._event.is_set():
                return False
            sleeper = _Sleeper(self._event)
            clock.followers.append(sleeper)
            self._event.wait_ns(None)
            clock.followers.remove(sleeper)
            if sleeper.woken:
                self._event.clear()
        return self._wait_until(clock, until)

    wait_until_steady = _wait_until
    wait_until_system = _wait_until


class _Sleeper:
    """Wakes a sleep whenever its clock shows another time."""

    def __init__(self, event: SimEvent) -> None:
        self._event = event
        self.woken = False

    def time_changes(self) -> None:
        """Sleep on: only the new time matters."""

    def time_changed(self, *, switched: bool) -> None:
        if not self._event.is_set():
            self.woken = True
            self._event.set()
