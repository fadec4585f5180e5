"""The handle of ``rclpy.Timer``: rcl's arithmetic on simulated time."""

from __future__ import annotations

import inspect
import struct
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from rsltrace.doors.rclpy.boundary.callback_groups import begin, is_busy
from rsltrace.doors.rclpy.boundary.entity_handle import EntityHandle
from rsltrace.doors.rclpy.stacks.tasks import is_coroutine_function, start_coroutine
from rsltrace.loop.timer import TimerState
from rsltrace.model.entity import EntityKind
from rsltrace.model.event import NO_EVENT, EventKind, OutputKind
from rsltrace.trace.chain import hash64

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.boundary.boundary import Boundary
    from rsltrace.doors.rclpy.core import Core

_TIMER = int(EventKind.TIMER)
_pack_deadline = struct.Struct("<Q").pack

# Operations of TIMER outputs; part of the trace format.
OP_CANCEL = 1
OP_RESET = 2
OP_PERIOD = 3


class TimerHandle(EntityHandle):
    """Stands in for ``_rclpy.Timer``. It runs once the node that lists it is being run."""

    kind = EntityKind.TIMER
    lists = "timers"

    def __init__(
        self, boundary: Boundary, core: Core, clock: Any, period_ns: int, autostart: bool
    ) -> None:
        if period_ns < 0:
            raise boundary.real.RCLError("timer period must be non-negative")
        super().__init__(core, None)
        self._boundary = boundary
        self.state = TimerState(
            int(period_ns),
            core.loop.now_ns,
            order=self.entity_id,
            owner=self,
            canceled=not autostart,
        )
        self._callback: Any = None
        self._coroutine = False
        self._info: str | None = None

    def activate(self) -> None:
        if self.wrapper is not None and not self.state.canceled and not self.destroyed:
            self.core.loop.timers.add(self.state)

    def deactivate(self) -> None:
        super().deactivate()
        self.core.loop.timers.remove(self.state)

    def dispatch(self) -> None:
        """Run the callback of a timer that is due, and move it to its next deadline."""
        wrapper = self.wrapper
        core = self.core
        state = self.state
        mailbox = self.node.mailbox  # type: ignore[union-attr]  # it has been activated
        if mailbox is not None:
            if mailbox.keeps(self):
                core.loop.timers.remove(state)
                return
            if wrapper is None or state.canceled or state.deadline_ns > core.loop.now_ns:
                return
            core.loop.timers.add(state)
        group = wrapper.callback_group
        if getattr(group, "_active_entity", group) is not None and is_busy(group, wrapper):
            core.loop.timers.remove(state)
            core.park(group, self, self.activate)
            return
        callback = wrapper.callback
        if callback is not self._callback:
            self._callback = callback
            self._coroutine = is_coroutine_function(callback)
            self._info = _info_parameter(callback)
        digest = hash64(_pack_deadline(state.deadline_ns)) if core.recorder is not None else 0
        if self._info is not None:
            callback = partial(callback, **{self._info: self._timer_info()})
        state.call(core.loop.now_ns)
        core.loop.timers.ran(state)
        if self._coroutine:
            begin(group, wrapper)
            start_coroutine(core, self, _TIMER, callback, (), NO_EVENT, 0, digest)
        else:
            core.execute(self, self.entity_id, self.node, _TIMER, callback, (), NO_EVENT, 0, digest)

    def _timer_info(self) -> Any:
        from rclpy.timer import TimerInfo

        return TimerInfo(
            expected_call_time=self.state.deadline_ns,
            actual_call_time=self.core.loop.now_ns,
            clock_type=self.wrapper.clock.clock_type,
        )

    def _note(self, operation: int, value: int) -> None:
        if self.wrapper is not None:
            self.core.note(OutputKind.TIMER, self.entity_id, operation, value)

    # -- what rclpy calls ----------------------------------------------------------------------

    def call_timer(self) -> None:
        """Account for a call made by hand."""
        if self.state.canceled:
            raise self._boundary.real.RCLError("timer is canceled")
        self.state.call(self.core.loop.now_ns)
        if self.wrapper is not None:
            self.core.loop.timers.moved(self.state)

    def call_timer_with_info(self) -> dict[str, int]:
        """Do ``call_timer`` and say when it was due and when it happened (ns)."""
        expected_ns = self.state.deadline_ns
        self.call_timer()
        return {"expected_call_time": expected_ns, "actual_call_time": self.core.loop.now_ns}

    def cancel_timer(self) -> None:
        """Stop; ``reset_timer`` starts again."""
        self.state.canceled = True
        self.core.loop.timers.remove(self.state)
        self._note(OP_CANCEL, 0)

    def reset_timer(self) -> None:
        """Start a new period now."""
        self.state.reset(self.core.loop.now_ns)
        if self.wrapper is not None:
            self.core.loop.timers.add(self.state)
        self._note(OP_RESET, self.state.deadline_ns)

    def change_timer_period(self, period_ns: int) -> None:
        """Set the period; the present deadline stays."""
        if period_ns < 0:
            raise self._boundary.real.RCLError("timer period must be non-negative")
        if period_ns != self.state.period_ns:
            self.state.period_ns = period_ns
            self._note(OP_PERIOD, period_ns)

    def get_timer_period(self) -> int:
        """Return the period in nanoseconds."""
        return self.state.period_ns

    def is_timer_ready(self) -> bool:
        """Return whether the timer is due."""
        return not self.state.canceled and self.state.deadline_ns <= self.core.loop.now_ns

    def is_timer_canceled(self) -> bool:
        """Return whether the timer is cancelled."""
        return self.state.canceled

    def time_until_next_call(self) -> int | None:
        """Return nanoseconds to the deadline (negative: overdue), None if cancelled."""
        if self.state.canceled:
            return None
        return self.state.deadline_ns - self.core.loop.now_ns

    def time_since_last_call(self) -> int:
        """Return nanoseconds since the last call, or since creation."""
        return self.core.loop.now_ns - self.state.last_call_ns

    # -- the trace -----------------------------------------------------------------------------

    def trace_detail(self) -> dict[str, object]:
        return {"period_ns": self.state.period_ns}

    def _destroy(self) -> None:
        self.core.loop.timers.remove(self.state)


def _info_parameter(callback: Any) -> str | None:
    """Return which parameter of a callback wants a TimerInfo (ROS 2 Kilted and later)."""
    import rclpy.timer

    wanted = getattr(rclpy.timer, "TimerInfo", None)
    if wanted is None:
        return None
    with suppress(TypeError, ValueError):  # no signature: then it wants none
        for parameter in inspect.signature(callback).parameters.values():
            if parameter.annotation == wanted:
                return parameter.name
    return None
