"""A stack in rclpy's spin: what is ready for its executor runs on it at once.

A stack that waits for work in ``spin_once`` would be woken, take what is ready from a mailbox and
run it next. So the loop's runner switches to it with what is ready, and it runs that where it
waits. Between two callbacks rclpy's ``spin`` only asks whether to go on, and nobody sees it do so,
as long as a callback has left everything as it was: then the stack stays in its wait. Code runs
where it always ran and when it did: it may block, spin or raise there as ever. After a callback
that leaves anything to see or to do for ``spin``, that goes on as usual.
"""

from __future__ import annotations

import sys
from asyncio import _get_running_loop
from collections.abc import Callable
from functools import lru_cache
from types import CodeType, FrameType
from typing import Any, NamedTuple, Protocol

from greenlet import getcurrent, greenlet

from rsltrace.adapters.rclpy.handles.entity_handle import ReceiverHandle
from rsltrace.adapters.rclpy.stacks.callback_groups import is_busy, is_custom
from rsltrace.adapters.rclpy.stacks.mailbox import Mailbox
from rsltrace.adapters.rclpy.stacks.runtime import Stacks, Wait
from rsltrace.simulation.loop.loop import Dispatchable, EventLoop
from rsltrace.simulation.loop.timer_queue import CreationOrderQueue
from rsltrace.simulation.middleware.events.event import OutsideEvent


class Waker(Protocol):
    """The pump of the executor that spins."""

    executor: Any
    standby: Standby | None
    waits: list[Wait]
    woken: bool


class Standby:
    """One stack in a spin. ``future`` is what it spins for, None if for ever; ``once`` says that it
    goes on itself after each callback."""

    def __init__(self, stacks: Stacks, pump: Waker, future: Any, *, once: bool) -> None:
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
        self._once = once
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
        if self._loop.tasks or self._dispatcher.has_outputs() or not self._takes(item):
            return False
        self._waiting.append(getcurrent())
        self.blocked.stack.switch(mailbox, item)
        return True

    def _takes(self, item: Dispatchable) -> bool:
        """Return whether the spin would take what is ready, and could run it now."""
        future = self._future
        return not self.blocked.woken and (future is None or not future.done()) and _is_free(item)

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
        entities, own_stack = dispatcher.entities, blocked.stack
        if self._once:
            blocked.stop_waiting()  # its time limit means nothing to a callback that blocks
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
            recorder = dispatcher.recorder
            if (
                self._once
                or failure is not None
                or pump.woken
                or not context.is_up
                or entities.pending
                or (dispatcher.unrecorded if recorder is None else recorder.outputs)
                or (future is not None and (future.done() or future.cancelled()))
            ):
                break
            event.handle, event.entity, event.node = blocked.event
            for observer in dispatcher.node_observers:
                observer.node_entered(event.node, is_made=False)
            pump.standby = self
            all_blocked[blocked] = None
            following = self._following()
            if following is not None:
                stack, mailbox, item = following
                if stack is own_stack:
                    continue
                given = stack.switch(mailbox, item)
            else:
                if programs.present is not host:
                    host.enter()
                given = (waiting.pop() if waiting else self._runners.next()).switch()
            if not given:
                return False
            mailbox, item = given
        blocked.follow(self._loop.events - 1)
        self.failure = failure
        self.is_over = True
        return True

    def _following(self) -> tuple[greenlet, Mailbox, Dispatchable] | None:
        """Take what the loop would dispatch next, if a stack that stands by would run it: that goes
        on at once, without the loop and the host between them."""
        loop = self._loop
        if loop.tasks or not loop.ready or loop.events >= loop.looks_at:
            return None
        item = loop.ready[0]
        if not isinstance(item, ReceiverHandle) or item.node is None:
            return None
        mailbox: Mailbox | None = item.node.mailbox
        if mailbox is None or mailbox.pump is None:
            return None
        standby: Any = mailbox.pump.standby
        if standby is None or not standby._takes(item):
            return None
        loop.ready.popleft()
        return standby.blocked.stack, mailbox, item


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
    stacks: Stacks, pump: Waker, nodes: object, condition: Callable[[], bool], *, has_limit: bool
) -> Standby | None:
    """Return what stands by for the spin that looks for work, None if that is not possible.

    ``has_limit`` says that it waits for some time only.
    """
    event = stacks.event
    if (
        nodes is not None
        or pump.waits
        or pump.standby is not None
        or type(stacks.loop) is not EventLoop
        or type(stacks.loop.timers) is not CreationOrderQueue
        or stacks.dispatcher.resume_observers
        or event.on_end is not None
        or not isinstance(event.handle, OutsideEvent)
        or _get_running_loop() is not None
    ):
        return None
    own = _rclpys_own()
    frame: FrameType | None = sys._getframe(3)
    if frame is None or frame.f_code is not own.one_turn:
        return None
    future = None
    if condition is not own.never:
        future = getattr(condition, "__self__", None)
        if future is None or getattr(condition, "__func__", None) is not own.done:
            return None
    while frame is not None and frame.f_code in own.turns:
        frame = frame.f_back
    is_endless = not has_limit and frame is not None and frame.f_code in own.spins
    return Standby(stacks, pump, future, once=not is_endless)


class _RclpysOwn(NamedTuple):
    """Code of rclpy's ``SingleThreadedExecutor``: what runs one callback, those who call it, and
    those who do so again and again; the condition that is never met, and ``Future.done``."""

    one_turn: CodeType | None
    turns: frozenset[CodeType]
    spins: frozenset[CodeType]
    never: Any
    done: Any


@lru_cache(maxsize=1)
def _rclpys_own() -> _RclpysOwn:
    import rclpy
    from rclpy.executors import Executor, SingleThreadedExecutor
    from rclpy.task import Future

    names = ("_spin_once_impl", "spin_once", "spin_once_until_future_complete")
    single = vars(SingleThreadedExecutor)
    spins = (Executor.spin, Executor.spin_until_future_complete, rclpy.spin)
    one_turn = single.get(names[0])
    return _RclpysOwn(
        getattr(one_turn, "__code__", None),
        frozenset(single[name].__code__ for name in names if name in single),
        frozenset(spin.__code__ for spin in spins),
        (getattr(one_turn, "__defaults__", None) or (None,))[-1],
        Future.done,
    )


class Ran:
    """What rclpy's executor is given as a Task that it has run: the callback has run already."""

    def __init__(self, failure: BaseException | None = None) -> None:
        self._failure = failure

    def __call__(self) -> None:
        """Do as a Task does: only what is no Exception comes out at once."""
        if self._failure is not None and not isinstance(self._failure, Exception):
            raise self._failure

    def exception(self) -> BaseException | None:
        """Return what the callback raised."""
        return self._failure

    def result(self) -> None:
        """Raise what the callback raised."""
        if self._failure is not None:
            raise self._failure


__all__ = ["Ran", "Standby", "standby_of"]
