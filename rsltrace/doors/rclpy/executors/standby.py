"""A stack that does nothing but spin: what is ready for its executor runs on it at once.

Between two callbacks rclpy's ``spin`` only asks whether to go on, and nobody sees it do so, as long
as a callback has left everything as it was. So the stack stays in its wait; the loop's runner
switches to it with what is ready, it runs that and waits on. Code runs where it always ran and when
it did: it may block, spin or raise there as ever. After a callback that leaves anything to see or
to do for ``spin``, that goes on as usual.
"""

from __future__ import annotations

import sys
from asyncio import _get_running_loop
from collections.abc import Callable
from functools import lru_cache
from types import CodeType, FrameType
from typing import Any, Protocol

from greenlet import getcurrent

from rsltrace.doors.rclpy.stacks.callback_groups import is_busy, is_custom
from rsltrace.doors.rclpy.stacks.mailbox import Mailbox
from rsltrace.doors.rclpy.stacks.runners import Wait
from rsltrace.doors.rclpy.stacks.stacks import Stacks
from rsltrace.loop.loop import Dispatchable, EventLoop
from rsltrace.loop.timer_queue import CreationOrderQueue
from rsltrace.middleware.events.event import OutsideEvent


class Waker(Protocol):
    """The pump of the executor that spins."""

    executor: Any
    standby: Standby | None
    waits: list[Wait]
    woken: bool


class Standby:
    """One stack in a spin. ``future`` is what it spins for, None if for ever."""

    def __init__(self, stacks: Stacks, pump: Waker, future: Any) -> None:
        self._stacks = stacks
        self._loop = stacks.loop
        self._dispatcher = stacks.dispatcher
        self._event = stacks.event
        self._programs = stacks.programs
        self._waiting = stacks.runners.waiting
        self._pump = pump
        self._context = pump.executor.context.handle
        self._future = future
        self.blocked: Wait
        """The wait of the spin."""
        self.is_over = False
        """Whether something has run after which the spin has to look itself."""
        self.failure: BaseException | None = None
        """What came out of that, which the spin raises."""

    def begin(self, blocked: Wait) -> None:
        """Stand by from now on."""
        self.blocked = blocked
        self._pump.standby = self

    def runs(self, mailbox: Mailbox, item: Dispatchable) -> bool:
        """Run what is ready, if the spin would take it next and run it, on the stack that spins.

        Called on the stack that runs the loop.
        """
        blocked = self.blocked
        if self._loop.tasks or not blocked.waiting or self._dispatcher.has_outputs():
            return False
        wrapper = getattr(item, "wrapper", None)
        group = getattr(wrapper, "callback_group", None)
        if group is not None:
            own = getattr(item, "own_group", None)
            if is_custom(group) if own is None else own:
                return False
            if getattr(group, "_active_entity", group) is not None and is_busy(group, wrapper):
                return False
        if getattr(item, "destroyed", False):
            return False
        self._waiting.append(getcurrent())
        blocked.stack.switch(mailbox, item)
        return True

    def serve(self, mailbox: Mailbox, item: Dispatchable) -> bool:
        """Run one callback; False if the spin has to go on itself. Called on its stack."""
        pump, programs, blocked = self._pump, self._programs, self.blocked
        pump.standby = None
        pump.woken = False
        if blocked.program is not programs.present:
            blocked.program.enter()
        programs.constructing = blocked.constructing
        failure: BaseException | None = None
        try:
            mailbox.run(item)
            failure, mailbox.raised = mailbox.raised, None
        except BaseException as error:
            failure = error
        if (
            failure is None
            and not pump.woken
            and self._context.ok()
            and not self._dispatcher.has_outputs()
            and (self._future is None or not (self._future.done() or self._future.cancelled()))
        ):
            blocked.stay()
            pump.standby = self
            return True
        blocked.follow(self._loop.events - 1)
        self.failure = failure
        self.is_over = True
        return False


def standby_of(
    stacks: Stacks, pump: Waker, nodes: object, condition: Callable[[], bool]
) -> Standby | None:
    """Return what stands by for the spin that looks for work, None if that is not possible."""
    event = stacks.event
    if (
        nodes is not None
        or pump.waits
        or pump.standby is not None
        or type(stacks.loop) is not EventLoop
        or type(stacks.loop.timers) is not CreationOrderQueue
        or stacks.dispatcher.on_resume is not None
        or event.on_end is not None
        or not isinstance(event.handle, OutsideEvent)
        or _get_running_loop() is not None
        or not _only_spins(sys._getframe(3))
    ):
        return None
    done = _rclpy_codes()[2]
    future = getattr(condition, "__self__", None)
    if future is not None and getattr(condition, "__func__", None) is not done:
        return None
    return Standby(stacks, pump, future)


def _only_spins(frame: FrameType | None) -> bool:
    """Say whether what looks for work is rclpy's own spin, with nobody in between."""
    parts, whole, _ = _rclpy_codes()
    while frame is not None and frame.f_code in parts:
        frame = frame.f_back
    return frame is not None and frame.f_code in whole


@lru_cache(maxsize=1)
def _rclpy_codes() -> tuple[frozenset[CodeType], frozenset[CodeType], Any]:
    """Return the code by which one callback is run, that which does so again and again, and
    ``Future.done``."""
    import rclpy
    from rclpy.executors import Executor, SingleThreadedExecutor
    from rclpy.task import Future

    names = ("_spin_once_impl", "spin_once", "spin_once_until_future_complete")
    single = vars(SingleThreadedExecutor)
    parts = {single[name].__code__ for name in names if name in single}
    whole = {
        Executor.spin.__code__,
        Executor.spin_until_future_complete.__code__,
        rclpy.spin.__code__,
    }
    return frozenset(parts), frozenset(whole), Future.done


__all__ = ["Standby", "standby_of"]
