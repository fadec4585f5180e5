"""Clocks: ROS, system and steady time are all simulated time, as each node's clock shows it."""

from __future__ import annotations

import weakref
from typing import Any

from rsltrace.doors.rclpy.handles.destroyable import Handle
from rsltrace.doors.rclpy.stacks.sim_event import SimEvent


class _Now:
    """The part of ``rcl_time_point_t`` that rclpy reads."""

    __slots__ = ("nanoseconds",)

    def __init__(self, nanoseconds: int) -> None:
        self.nanoseconds = nanoseconds


class ClockHandle(Handle):
    """Stands in for ``_rclpy.Clock``.

    A clock outlives runs (rclpy itself keeps one in a class attribute), so it asks the boundary
    for the world of the moment; between runs it stands at the last simulated time.
    """

    boundary: Any

    def __init__(self, clock_type: Any) -> None:
        super().__init__()
        self.clock_type = clock_type
        self._override = False
        self._callbacks: list[tuple[Any, bool, int, int]] = []
        self._owner: str | None = self.boundary.current_node_name()
        if clock_type == self.boundary.ClockType.ROS_TIME:
            self.boundary.ros_clocks.append(weakref.ref(self))

    def get_now(self) -> _Now:
        """Return simulated time, or what the clock of this node's computer shows instead."""
        return _Now(self.boundary.look_ns(self._owner))

    def now_ns(self) -> int:
        """Return the same without that it counts as a look."""
        return int(self.boundary.shown_ns(self._owner))

    def get_ros_time_override_is_enabled(self) -> bool:
        """Return whether ``use_sim_time`` switched this clock; it shows simulated time anyway."""
        return self._override

    def set_ros_time_override_is_enabled(self, enabled: bool) -> None:
        """Remember the switch and tell those who asked for clock changes."""
        if enabled == self._override:
            return
        changes = self.boundary.ClockChange
        change = changes.ROS_TIME_ACTIVATED if enabled else changes.ROS_TIME_DEACTIVATED
        wanted = [entry for entry in self._callbacks if entry[1]]
        self._jump(wanted, change, 0, lambda: setattr(self, "_override", enabled))

    def set_ros_time_override(self, time_point: Any) -> None:
        """Ignore ``/clock``: the loop is the only source of time in a simulation."""

    def add_clock_callback(
        self, jump_handle: Any, on_clock_change: bool, min_forward: int, min_backward: int
    ) -> None:
        """Register a jump handle; thresholds in nanoseconds, 0 for none."""
        self._callbacks.append((jump_handle, on_clock_change, min_forward, min_backward))

    def remove_clock_callback(self, jump_handle: Any) -> None:
        """Forget a jump handle."""
        self._callbacks = [entry for entry in self._callbacks if entry[0] is not jump_handle]

    def jumped(self, delta_ns: int) -> None:
        """Tell those whose threshold a jump of simulated time exceeds (start of the run)."""
        wanted = [
            entry
            for entry in self._callbacks
            if (delta_ns > 0 and 0 < entry[2] <= delta_ns)
            or (delta_ns < 0 and delta_ns <= entry[3] < 0)
        ]
        change = self.boundary.ClockChange
        kind = change.ROS_TIME_NO_CHANGE if self._override else change.SYSTEM_TIME_NO_CHANGE
        self._jump(wanted, kind, delta_ns, lambda: None)

    def _jump(self, entries: list[Any], change: Any, delta_ns: int, act: Any) -> None:
        for jump_handle, *_ in entries:
            if jump_handle._pre_callback is not None:
                jump_handle._pre_callback()
        act()
        for jump_handle, *_ in entries:
            if jump_handle._post_callback is not None:
                jump_handle._post_callback({"clock_change": change, "delta": delta_ns})


class ClockEventHandle:
    """Stands in for ``_rclpy.ClockEvent``: sleeping until a time, or until it is set."""

    boundary: Any

    def __init__(self) -> None:
        self._event = SimEvent(self.boundary.stacks, "a time to come (Clock.sleep_until)")

    def set(self) -> None:
        """Wake sleepers."""
        self._event.set()

    def clear(self) -> None:
        """Let sleepers sleep again."""
        self._event.clear()

    def is_set(self) -> bool:
        """Return whether it is set."""
        return self._event.is_set()

    def _wait_until(self, clock: Any, until: Any) -> bool:
        left_ns = until.nanoseconds - clock.now_ns()
        return left_ns <= 0 or self._event.wait_ns(left_ns)

    wait_until_steady = _wait_until
    wait_until_system = _wait_until
    wait_until_ros = _wait_until
