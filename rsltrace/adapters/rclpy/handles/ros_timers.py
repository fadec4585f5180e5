"""Timers of ROS clocks that ``/clock`` drives: due when that shows their deadline.

The rules for jumps and for switching ROS time on and off are those of ``rcl/src/rcl/timer.c``.
"""

from __future__ import annotations

from typing import Any

from rsltrace.adapters.rclpy.handles.clock import ClockHandle
from rsltrace.adapters.rclpy.handles.timers import TimerHandle
from rsltrace.adapters.rclpy.stacks.callback_groups import is_busy
from rsltrace.adapters.rclpy.stacks.stacks import Stacks
from rsltrace.adapters.rclpy.stacks.tasks import is_awaited, start_callback
from rsltrace.simulation.middleware.timer import TIMER
from rsltrace.trace.model.event import NO_EVENT


class RosTimerHandle(TimerHandle):
    """A timer by a clock's own time while that is driven, by simulated time otherwise."""

    def __init__(
        self, real: Any, stacks: Stacks, clock: ClockHandle, period_ns: int, autostart: bool
    ) -> None:
        self._clock = clock
        self._credit_ns = 0
        self._ready = False
        super().__init__(real, stacks, period_ns, autostart)
        if clock.is_driven:
            self._count_from(clock.now_ns())
        clock.followers.append(self)

    def _count_from(self, last_ns: int) -> None:
        self.state.last_call_ns = last_ns
        self.state.deadline_ns = last_ns + self.state.period_ns

    # -- the clock -------------------------------------------------------------------------------

    def time_changes(self) -> None:
        """Keep how much of the period is over: only the rest is waited for in the new time."""
        now_ns = self._clock.now_ns()
        if now_ns:
            self._credit_ns = now_ns - self.state.last_call_ns

    def time_changed(self, *, switched: bool) -> None:
        """See whether the timer is due, or its clock has been set back behind its last call."""
        now_ns = self._clock.now_ns()
        if switched:
            self.dispatcher.loop.timers.remove(self.state)
            if now_ns and self._credit_ns:
                self._count_from(now_ns - self._credit_ns)
                self._credit_ns = 0
        elif now_ns < self.state.last_call_ns:
            self._count_from(now_ns)
        self.activate()

    def activate(self) -> None:
        """Let the loop run it when its clock says that it is due."""
        if not self._clock.is_driven:
            super().activate()
            return
        waits = self._ready or not self.active or self.state.canceled or self.destroyed
        if not waits and self.state.deadline_ns <= self._clock.now_ns():
            self._ready = True
            self.dispatcher.loop.ready.append(self)

    def dispatch(self) -> None:
        """Run the callback if the timer is still due by its clock."""
        if not self._clock.is_driven:
            super().dispatch()
            return
        mailbox = self.node.mailbox
        if mailbox is not None and mailbox.keeps(self):
            return
        self._ready = False
        wrapper, state, now_ns = self.wrapper, self.state, self._clock.now_ns()
        if wrapper is None or self.destroyed or state.canceled or state.deadline_ns > now_ns:
            return
        if self.own_group:
            if not self.stacks.groups.enter(self, wrapper, self.activate):
                return
        elif is_busy(wrapper.callback_group, wrapper):
            self.stacks.groups.park(wrapper.callback_group, self, self.activate)
            return
        callback, digest = wrapper.callback, self.deadline_hash()
        state.call(now_ns)
        if is_awaited(self.stacks, callback):
            start_callback(self.stacks, self, TIMER, callback, (), NO_EVENT, 0, digest)
        else:
            self.dispatcher.execute(
                self, self.entity_id, self.node, TIMER, callback, (), NO_EVENT, 0, digest
            )
        self.activate()

    # -- what rclpy calls ------------------------------------------------------------------------

    def call_timer(self) -> None:
        """Account for a call made by hand."""
        if not self._clock.is_driven:
            super().call_timer()
            return
        if self.state.canceled:
            raise self._real.RCLError("timer is canceled")
        self.state.call(self._clock.now_ns())

    def reset(self) -> None:
        """Start a new period now."""
        super().reset()
        if self._clock.is_driven:
            self.dispatcher.loop.timers.remove(self.state)
            self.state.reset(self._clock.now_ns())
            self.activate()

    def is_timer_ready(self) -> bool:
        """Return whether the timer is due."""
        return not self.state.canceled and self.state.deadline_ns <= self._clock.now_ns()

    def time_until_next_call(self) -> int | None:
        """Return nanoseconds to the deadline (negative: overdue), None if cancelled."""
        return None if self.state.canceled else self.state.deadline_ns - self._clock.now_ns()

    def time_since_last_call(self) -> int:
        """Return nanoseconds since the last call, or since creation."""
        return self._clock.now_ns() - self.state.last_call_ns

    def _destroy(self) -> None:
        super()._destroy()
        if self in self._clock.followers:
            self._clock.followers.remove(self)
