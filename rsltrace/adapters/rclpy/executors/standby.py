"""A fast path for spinning executors: callbacks run where the spin waits.

A stack that waits in ``spin_once`` would wake up, take the ready callback from a mailbox and run
it. Instead the loop switches to that stack, which runs the callback inside its wait. Between two
callbacks ``spin`` only checks whether to go on; if a callback changed nothing that the check sees,
the stack stays in its wait. Otherwise ``spin`` goes on as usual. The order of callbacks, and where
they may block, spin or raise, are the same.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from types import CodeType, FrameType
from typing import Any, NamedTuple, Protocol

from greenlet import getcurrent, greenlet

from rsltrace.adapters.rclpy.concurrency.blocking_calls import running_loop
from rsltrace.adapters.rclpy.concurrency.callback_groups import is_busy, is_custom
from rsltrace.adapters.rclpy.concurrency.mailbox import Mailbox
from rsltrace.adapters.rclpy.concurrency.runtime import BlockedCall, Runtime
from rsltrace.adapters.rclpy.handles.entity_handle import ReceiverHandle
from rsltrace.guard.frames import code_of
from rsltrace.simulation.loop.loop import Dispatchable, EventLoop
from rsltrace.simulation.loop.timer_queue import CreationOrderQueue
from rsltrace.simulation.middleware.events.event import OutsideEvent
from rsltrace.simulation.middleware.subscription import NUMBER


class StandbyOwner(Protocol):
    """The driver of the spinning executor."""

    executor: Any
    standby: Standby | None
    waits: list[BlockedCall]
    woken: bool


class Standby:
    """One spinning stack. ``future`` is what it spins for (None: for ever). With ``once`` the spin
    goes on after each callback."""

    def __init__(self, runtime: Runtime, driver: StandbyOwner, future: Any, *, once: bool) -> None:
        self._runtime = runtime
        self._loop = runtime.loop
        self._dispatcher = runtime.dispatcher
        self._event = runtime.event
        self._programs = runtime.programs
        self._runners = runtime.runners
        self._waiting = runtime.runners.waiting
        self._all_blocked = runtime.runners.blocked
        self._driver = driver
        self._context = driver.executor.context.handle
        self._future = future
        self._once = once
        self.blocked: BlockedCall
        """The spin's wait."""
        self.is_over = False
        """Whether the spin has to go on itself after the last callback."""
        self.failure: BaseException | None = None
        """The exception of that callback, which the spin raises."""

    def begin(self, blocked: BlockedCall) -> None:
        """Stand by from now on."""
        self.blocked = blocked
        self._driver.standby = self

    def runs(self, mailbox: Mailbox, item: Dispatchable) -> bool:
        """Run an item on the spinning stack, if the spin would take it next.

        Called on the stack that runs the loop.
        """
        if self._loop.tasks or self._dispatcher.has_outputs() or not self._takes(item):
            return False
        self._waiting.append(getcurrent())
        self.blocked.stack.switch(mailbox, item)
        return True

    def _takes(self, item: Dispatchable) -> bool:
        """Return whether the spin would take the item and could run it now."""
        future = self._future
        return not self.blocked.woken and (future is None or not future.done()) and _is_free(item)

    def serve(self, mailbox: Mailbox, item: Dispatchable) -> bool:
        """Run the given callback and those that follow, waiting in between.

        Returns whether the spin has to go on itself (see ``is_over``); if not, the wait has ended.
        """
        driver, programs, dispatcher, event = (
            self._driver,
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
            driver.standby = None
            driver.woken = False
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
                or driver.woken
                or not context.is_up
                or entities.pending
                or (dispatcher.unrecorded if recorder is None else recorder.outputs)
                or (future is not None and (future.done() or future.cancelled()))
            ):
                break
            event.handle, event.entity, event.node = blocked.event
            for observer in dispatcher.node_observers:
                observer.node_entered(event.node, is_made=False)
            driver.standby = self
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
        """Take the loop's next item if a standby stack would run it, to switch there directly."""
        loop = self._loop
        queue: deque[Any] = loop.ready
        if loop.looks_at < 0:
            if not loop.scheduled or len(loop.scheduled[0]) <= NUMBER:
                return None  # no message: actions have to be called on the other stack
            item = loop.next_arrival()
            if item is False:
                return None
            loop.stepped_ns = loop.now_ns
            if item is None:
                return None
            queue = loop.tasks  # it has been the turn of this one
            if queue or self._dispatcher.has_outputs():
                queue.appendleft(item)
                return None
        elif loop.tasks or not loop.ready or loop.events >= loop.looks_at:
            return None
        else:
            item = queue.popleft()
        mailbox: Mailbox | None = None
        if isinstance(item, ReceiverHandle) and item.node is not None:
            mailbox = item.node.mailbox
        if mailbox is not None and mailbox.driver is not None:
            standby: Any = mailbox.driver.standby
            if standby is not None and standby._takes(item):
                return standby.blocked.stack, mailbox, item
        queue.appendleft(item)
        return None


def _is_free(item: Any) -> bool:
    """Return whether a callback may run now, without asking a custom callback group."""
    try:
        group, own = item.wrapper.callback_group, item.own_group
    except AttributeError:  # no entity of rclpy, or one that no longer runs
        wrapper = getattr(item, "wrapper", None)
        group = getattr(wrapper, "callback_group", None)
        return group is None or not (is_custom(group) or is_busy(group, wrapper))
    if own or item.destroyed:
        return False
    if getattr(group, "_active_entity", group) is None:  # nearly always
        return True
    return not is_busy(group, item.wrapper)


def standby_of(
    runtime: Runtime,
    driver: StandbyOwner,
    nodes: object,
    condition: Callable[[], bool],
    *,
    has_limit: bool,
) -> Standby | None:
    """Return a standby for the calling spin, None if it cannot have one.

    ``has_limit``: the spin waits with a timeout.
    """
    event = runtime.event
    if (
        nodes is not None
        or driver.waits
        or driver.standby is not None
        or type(runtime.loop) is not EventLoop
        or type(runtime.loop.timers) is not CreationOrderQueue
        or runtime.dispatcher.resume_observers
        or event.on_end is not None
        or not isinstance(event.handle, OutsideEvent)
        or running_loop() is not None
    ):
        return None
    own = _rclpy_code()
    frame: FrameType | None = sys._getframe(3)
    if frame is None or code_of(frame) is not own.one_turn:
        return None
    future = None
    if condition is not own.never:
        future = getattr(condition, "__self__", None)
        if future is None or getattr(condition, "__func__", None) is not own.done:
            return None
    while frame is not None and code_of(frame) in own.turns:
        frame = frame.f_back
    is_endless = not has_limit and frame is not None and code_of(frame) in own.spins
    return Standby(runtime, driver, future, once=not is_endless)


class _RclpyCode(NamedTuple):
    """Code of rclpy's ``SingleThreadedExecutor``: the function that runs one callback, its callers,
    the spin loops, the condition that is never met, and ``Future.done``."""

    one_turn: CodeType | None
    turns: frozenset[CodeType]
    spins: frozenset[CodeType]
    never: Any
    done: Any


@lru_cache(maxsize=1)
def _rclpy_code() -> _RclpyCode:
    import rclpy
    from rclpy.executors import Executor, SingleThreadedExecutor
    from rclpy.task import Future

    names = ("_spin_once_impl", "spin_once", "spin_once_until_future_complete")
    single = vars(SingleThreadedExecutor)
    spins = (Executor.spin, Executor.spin_until_future_complete, rclpy.spin)
    one_turn = single.get(names[0])
    return _RclpyCode(
        getattr(one_turn, "__code__", None),
        frozenset(single[name].__code__ for name in names if name in single),
        frozenset(spin.__code__ for spin in spins),
        (getattr(one_turn, "__defaults__", None) or (None,))[-1],
        Future.done,
    )


class FinishedTask:
    """Stands in for a Task whose callback has already run."""

    def __init__(self, failure: BaseException | None = None) -> None:
        self._failure = failure

    def __call__(self) -> None:
        """Raise at once only what is no Exception, as a Task does."""
        if self._failure is not None and not isinstance(self._failure, Exception):
            raise self._failure

    def exception(self) -> BaseException | None:
        return self._failure

    def result(self) -> None:
        if self._failure is not None:
            raise self._failure
