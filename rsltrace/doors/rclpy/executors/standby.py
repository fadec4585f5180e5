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
        self._runners = stacks.runners
        self._waiting = stacks.runners.waiting
        self._all_blocked = stacks.runners.blocked
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
        dispatcher = self._dispatcher
        recorder = dispatcher.recorder
        if (
            self._loop.tasks
            or blocked.woken
            or dispatcher.entities.pending
            or (dispatcher.unrecorded if recorder is None else recorder.outputs)
            or not _is_free(item)
        ):
            return False
        self._waiting.append(getcurrent())
        blocked.stack.switch(mailbox, item)
        return True

    def serve(self, mailbox: Mailbox, item: Dispatchable) -> bool:
        """Run what is given to the stack, one callback after the other, and wait in between.

        Returns whether the spin has to go on itself (see ``is_over``); else the wait was ended.
        """
        pump, programs, dispatcher, event = (
            self._pump,
            self._programs,
            self._dispatcher,
            self._event,
        )
        blocked, future, context, waiting = self.blocked, self._future, self._context, self._waiting
        all_blocked, host, program = self._all_blocked, programs.host, blocked.program
        while True:
            del all_blocked[blocked]
            pump.standby = None
            pump.woken = False
            if programs.present is not program:
                program.enter()
            programs.constructing = blocked.constructing
            try:
                mailbox.admitted = item  # what ``Mailbox.run`` does
                item.dispatch()
                mailbox.admitted = None
                failure, mailbox.raised = mailbox.raised, None
            except BaseException as error:
                failure = error
            if (
                failure is not None
                or pump.woken
                or not context.is_up
                or dispatcher.has_outputs()
                or (future is not None and (future.done() or future.cancelled()))
            ):
                break
            event.handle, event.entity, event.node = blocked.event
            if dispatcher.on_node is not None:
                dispatcher.on_node(event.node)
            if programs.present is not host:
                host.enter()
            pump.standby = self
            all_blocked[blocked] = None
            given = (waiting.pop() if waiting else self._runners.next()).switch()
            if not given:
                return False
            mailbox, item = given
        blocked.follow(self._loop.events - 1)
        self.failure = failure
        self.is_over = True
        return True


def _is_free(item: Any) -> bool:
    """Say whether nothing keeps a callback from running now, and nobody has to be asked."""
    try:
        group, own = item.wrapper.callback_group, item.own_group
    except AttributeError:  # no entity of rclpy's, or one that nobody runs any more
        wrapper = getattr(item, "wrapper", None)
        group = getattr(wrapper, "callback_group", None)
        return group is None or not (is_custom(group) or is_busy(group, wrapper))
    if own or item.destroyed:
        return False
    if getattr(group, "_active_entity", group) is None:  # nearly always
        return True
    return not is_busy(group, item.wrapper)


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
