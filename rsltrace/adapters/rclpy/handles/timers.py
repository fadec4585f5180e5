"""The handles of ``rclpy.Timer`` and ``rclpy.GuardCondition``, which are made without a node."""

from __future__ import annotations

import inspect
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from rsltrace.adapters.rclpy.concurrency.blocking_calls import SimEvent
from rsltrace.adapters.rclpy.concurrency.callback_groups import is_busy
from rsltrace.adapters.rclpy.concurrency.runtime import Runtime
from rsltrace.adapters.rclpy.concurrency.tasks import is_awaited, run_callback, start_callback
from rsltrace.adapters.rclpy.handles.clock import ClockHandle
from rsltrace.adapters.rclpy.handles.entity_handle import Alarm, EntityHandle
from rsltrace.compiled import TimerFields, core
from rsltrace.simulation.middleware.timer import TIMER, Timer
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventKind, OutputKind


class TimerHandle(EntityHandle, Timer, TimerFields):
    """Stands in for ``_rclpy.Timer``. It runs once a running node lists it."""

    lists = "timers"

    def __init__(self, real: Any, runtime: Runtime, period_ns: int, autostart: bool) -> None:
        if _int64(period_ns, "__init__(): incompatible constructor") < 0:
            raise real.RCLError("failed to create timer: timer period must be non-negative")
        self.runtime = runtime
        self._real = real
        self._callback: Any = None
        self._coroutine = False
        self._with_info: Any = False
        Timer.__init__(self, runtime.dispatcher, None, int(period_ns), canceled=not autostart)

    activate = Timer.activate

    def deactivate(self) -> None:
        super().deactivate()
        self.dispatcher.loop.timers.remove(self.state)

    def dispatch_any(self) -> None:
        """Run the callback of a due timer, if it may run, and set its next deadline."""
        wrapper = self.wrapper
        dispatcher = self.dispatcher
        loop = dispatcher.loop
        state = self.state
        mailbox = self.node.mailbox
        if mailbox is not None:
            if mailbox.keeps(self, self._leave):
                return
            if wrapper is None or state.canceled or state.deadline_ns > loop.now_ns:
                return
            loop.timers.add(state)
        group = wrapper.callback_group
        if self.own_group:
            if not self.runtime.groups.enter(self, wrapper, self.activate):
                loop.timers.remove(state)
                return
        elif getattr(group, "_active_entity", group) is not None and is_busy(group, wrapper):
            loop.timers.remove(state)
            self.runtime.groups.park(group, self, self.activate)
            return
        callback = wrapper.callback
        if callback is not self._callback:
            self._callback = callback
            self._coroutine = is_awaited(self.runtime, callback)
            self._with_info = _info_parameter(callback) or False
        digest = self.deadline_hash()
        if self._with_info:
            callback = partial(callback, **{self._with_info: self._timer_info()})
        state.call(loop.now_ns)
        loop.timers.ran(state)
        if self._coroutine:
            start_callback(self.runtime, self, TIMER, callback, (), NO_EVENT, 0, digest)
        else:
            dispatcher.execute(
                self, self.entity_id, self.node, TIMER, callback, (), NO_EVENT, 0, digest
            )

    if core is None or TYPE_CHECKING:
        dispatch = dispatch_any
    else:
        dispatch = core.TimerFields.dispatch
        """Does the usual case, a free group and a plain function of a node that the loop runs, and
        leaves the others to ``dispatch_any``."""

    def user_callback(self) -> object:
        """Return its callback, or rclpy's class ``Rate`` for the timer of one."""
        callback = super().user_callback()
        if isinstance(getattr(callback, "__self__", None), SimEvent):
            from rclpy.timer import Rate

            return Rate
        return callback

    def forget_callback(self) -> None:
        """Look up how to run the callback again."""
        self._callback = None

    def _leave(self) -> None:
        self.dispatcher.loop.timers.remove(self.state)

    def _timer_info(self) -> Any:
        from rclpy.timer import TimerInfo

        return TimerInfo(
            expected_call_time=self.state.deadline_ns,
            actual_call_time=self.dispatcher.loop.now_ns,
            clock_type=self.wrapper.clock.clock_type,
        )

    # -- what rclpy calls ----------------------------------------------------------------------

    def call_timer(self) -> None:
        """Account for a call by user code."""
        if self.state.canceled:
            raise self._real.RCLError("failed to call timer: timer is canceled")
        self.state.call(self.dispatcher.loop.now_ns)
        if self.active:
            self.dispatcher.loop.timers.moved(self.state)

    def call_timer_with_info(self) -> dict[str, int]:
        """Call ``call_timer``; return when it was due and when it happened (ns)."""
        expected_ns = self.state.deadline_ns
        self.call_timer()
        return {"expected_call_time": expected_ns, "actual_call_time": self.dispatcher.loop.now_ns}

    def cancel_timer(self) -> None:
        self.cancel()

    def reset_timer(self) -> None:
        self.reset()

    def change_timer_period(self, period_ns: int) -> None:
        """Set the period; the current deadline stays. rcl takes a negative one as 0."""
        self.set_period(max(_int64(period_ns, "change_timer_period(): incompatible function"), 0))

    def get_timer_period(self) -> int:
        return self.state.period_ns

    def is_timer_ready(self) -> bool:
        return not self.state.canceled and self.state.deadline_ns <= self.dispatcher.loop.now_ns

    def is_timer_canceled(self) -> bool:
        return self.state.canceled

    def time_until_next_call(self) -> int | None:
        """Return nanoseconds to the deadline (negative: overdue), None if cancelled."""
        if self.state.canceled:
            return None
        return self.state.deadline_ns - self.dispatcher.loop.now_ns

    def time_since_last_call(self) -> int:
        return self.dispatcher.loop.now_ns - self.state.last_call_ns


def _int64(period_ns: int, refusal: str) -> int:
    if not -(1 << 63) <= period_ns < 1 << 63:
        raise TypeError(f"{refusal} arguments: {period_ns} ns does not fit into 64 bits")
    return period_ns


def _info_parameter(callback: Any) -> str | None:
    """Return the parameter of a callback that takes a TimerInfo (ROS 2 Kilted and later)."""
    import rclpy.timer

    wanted = getattr(rclpy.timer, "TimerInfo", None)
    if wanted is None:
        return None
    with suppress(TypeError, ValueError):  # no signature
        for parameter in inspect.signature(callback).parameters.values():
            if parameter.annotation == wanted:
                return parameter.name
    return None


class RosTimerHandle(TimerHandle):
    """A timer of a ROS clock: by ``/clock`` while that drives the clock, else by simulated time.

    The rules for jumps and for switching ROS time on and off are those of ``rcl/src/rcl/timer.c``.
    """

    def __init__(
        self, real: Any, runtime: Runtime, clock: ClockHandle, period_ns: int, autostart: bool
    ) -> None:
        self._clock = clock
        self._credit_ns: int | None = None
        self._ready = False
        super().__init__(real, runtime, period_ns, autostart)
        if clock.is_driven:
            self._count_from(clock.now_ns())
        clock.followers.append(self)

    def _count_from(self, last_ns: int) -> None:
        self.state.last_call_ns = last_ns
        self.state.deadline_ns = last_ns + self.state.period_ns

    # -- the clock -------------------------------------------------------------------------------

    def time_changes(self) -> None:
        """Keep the elapsed part of the period: only the rest is waited for in the new time."""
        now_ns = self._clock.now_ns()
        if now_ns or not self._clock.is_driven:  # simulated time may begin at 0
            self._credit_ns = now_ns - self.state.last_call_ns

    def time_changed(self, *, switched: bool) -> None:
        """Check whether the timer is due, or its clock was set back before its last call."""
        now_ns = self._clock.now_ns()
        if switched:
            self.dispatcher.loop.timers.remove(self.state)
            if now_ns and self._credit_ns is not None:
                self._count_from(now_ns - self._credit_ns)
                self._credit_ns = None
        elif now_ns < self.state.last_call_ns:
            self._count_from(now_ns)
        self.activate()

    def activate(self) -> None:
        """Let the loop run it when it is due by its clock."""
        if not self._clock.is_driven:
            super().activate()
            return
        waits = self._ready or not self.active or self.state.canceled or self.destroyed
        if not waits and self.state.deadline_ns <= self._clock.now_ns():
            self._ready = True
            self.dispatcher.loop.ready.append(self)

    def dispatch(self) -> None:
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
            if not self.runtime.groups.enter(self, wrapper, self.activate):
                return
        elif is_busy(wrapper.callback_group, wrapper):
            self.runtime.groups.park(wrapper.callback_group, self, self.activate)
            return
        callback, digest = wrapper.callback, self.deadline_hash()
        state.call(now_ns)
        run_callback(self.runtime, self, TIMER, callback, (), NO_EVENT, 0, digest)
        self.activate()

    # -- what rclpy calls ------------------------------------------------------------------------

    def call_timer(self) -> None:
        if not self._clock.is_driven:
            super().call_timer()
            return
        if self.state.canceled:
            raise self._real.RCLError("failed to call timer: timer is canceled")
        self.state.call(self._clock.now_ns())

    def reset(self) -> None:
        super().reset()
        if self._clock.is_driven:
            self.dispatcher.loop.timers.remove(self.state)
            self.state.reset(self._clock.now_ns())
            self.activate()

    def is_timer_ready(self) -> bool:
        return not self.state.canceled and self.state.deadline_ns <= self._clock.now_ns()

    def time_until_next_call(self) -> int | None:
        return None if self.state.canceled else self.state.deadline_ns - self._clock.now_ns()

    def time_since_last_call(self) -> int:
        return self._clock.now_ns() - self.state.last_call_ns

    def _destroy(self) -> None:
        super()._destroy()
        if self in self._clock.followers:
            self._clock.followers.remove(self)


_GUARD = int(EventKind.GUARD_CONDITION)


class GuardConditionHandle(EntityHandle):
    """Stands in for ``_rclpy.GuardCondition``.

    A trigger before the last one was handled is merged with it. Executors make guard conditions,
    too; no node lists those, and their triggers do nothing. Each trigger calls the ``alarms``.
    """

    kind = EntityKind.GUARD_CONDITION
    lists = "guards"

    def __init__(self, runtime: Runtime) -> None:
        self.runtime = runtime
        super().__init__(runtime.dispatcher, None)
        self._triggered = False
        self._cause = (0, 0)
        self._found: tuple[int, int] | None = None
        self.alarms: tuple[Alarm, ...] = ()

    def trigger_guard_condition(self) -> None:
        if not self._triggered:
            self._triggered = True
            if self.active:
                loop, dispatcher = self.dispatcher.loop, self.dispatcher
                self._cause = (loop.events, dispatcher.note(OutputKind.GUARD, self.entity_id))
                loop.ready.append(self)
        for alarm in self.alarms:
            alarm()

    def found(self) -> None:
        """Take the triggers so far for a polling point; later ones are for the next."""
        if self._triggered:
            self._found, self._triggered = self._cause, False

    @property
    def is_due(self) -> bool:
        return self._triggered or self._found is not None

    def is_triggered(self) -> bool:
        return self._triggered

    def take_trigger(self) -> None:
        """Handle the triggers until now, as a wait set does."""
        self._triggered = False

    def activate(self) -> None:
        if self._triggered:
            self._cause = (self.dispatcher.loop.events, 0)
            self.dispatcher.loop.ready.append(self)

    def dispatch(self) -> None:
        """Run the callback once for all triggers until now."""
        if self.mailbox_keeps():
            return
        wrapper = self.wrapper
        if not self.is_due or wrapper is None or self.destroyed:
            return
        if self.runtime.groups.must_wait(self, wrapper):
            return
        cause = self._found
        if cause is None:
            cause, self._triggered = self._cause, False
        self._found = None
        run_callback(self.runtime, self, _GUARD, wrapper.callback, (), *cause, 0)
