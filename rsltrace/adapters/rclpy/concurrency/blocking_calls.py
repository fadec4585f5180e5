"""Blocking calls wait in simulated time: other callbacks run, then the call returns.

In the trace a wait ends the event (flag ``SUSPENDED``); the rest is a ``RESUME`` event.
``runtime.py`` switches the stacks. ``time.sleep`` and what rclpy waits with are replaced here.
"""

from __future__ import annotations

import os
import random
import sys
import threading
import time
import uuid
from _thread import get_ident
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import ModuleType
from typing import Any, NoReturn

from greenlet import getcurrent, greenlet

from rsltrace.adapters.rclpy.concurrency import callback_groups as groups
from rsltrace.adapters.rclpy.concurrency.runtime import BlockedCall, Patience, RunEnded, Runtime
from rsltrace.errors import UnsupportedError
from rsltrace.guard.libraries import present_import
from rsltrace.guard.recorded.processes import sleep_for_process
from rsltrace.guard.redirect import Redirected, copy_of, module_with, replace_attribute
from rsltrace.simulation.middleware.events.event import CurrentEvent
from rsltrace.trace.model.event import EventFlag, EventKind
from rsltrace.trace.model.texts import waiting_ns

POLL_NS = 1_000_000
"""The time that a second poll at one instant takes (a loop of ``spin_once(timeout_sec=0)``)."""

_RESUME = int(EventKind.RESUME)
_SUSPENDED = int(EventFlag.SUSPENDED)
getpid = copy_of(os.getpid)  # not the one that the guard watches
_PATIENCE = 100
"""How often a stack may wait after the end of the run before it is abandoned."""

# Stacks that ignore every exception (`while True: try: ... except: pass`). They must not be
# collected, as that would raise in them once more.
_abandoned: list[greenlet] = []


def wait(
    runtime: Runtime,
    what: object,
    *,
    until: Callable[[BlockedCall], None] | None = None,
    for_ns: int | None = None,
    quiet: bool = False,
    patient: Patience = False,
    serve: Callable[..., bool] | None = None,
) -> bool:
    """Block the current callback in simulated time; return whether it was woken (not timed out).

    ``until`` gets the BlockedCall and has its ``wake`` called later. ``what`` completes the text
    "… waits for". A ``quiet`` wait has a RESUME event only if that has outputs. A ``patient`` one
    may last for ever. ``serve`` runs a callback on this stack meanwhile, and returns whether the
    wait is over.

    :raises RunEnded: when the run ends before the wait does.
    :raises UnsupportedError: in a real thread, another process, or outside of all callbacks.
    """
    _check_may_wait(runtime, what)
    group = _hold_group(runtime)
    blocked = BlockedCall(runtime.runners, what, group, quiet=quiet, patient=patient)
    if until is not None:
        until(blocked)
    if for_ns is not None:
        blocked.deadline_ns = runtime.loop.now_ns + runtime.ending.grace_ns + max(for_ns, 0)
        runtime.loop.schedule(blocked.deadline_ns, blocked.time_out)
    _end_event_part(runtime)
    runtime.runners.blocked[blocked] = None
    runtime.event.on_end = None
    runtime.programs.leave()
    enter_asyncio = leave_asyncio()
    given = runtime.runners.next().switch()
    if given and serve is not None and serve(*given):
        enter_asyncio()
        blocked.stop_waiting()
        blocked.resumed()
        return True
    enter_asyncio()
    runtime.runners.blocked.pop(blocked, None)
    blocked.stop_waiting()
    blocked.resumed()
    if runtime.ending.unwinding:
        raise RunEnded
    if blocked.error is not None:
        error, blocked.error = blocked.error, None
        raise error
    return not blocked.timed_out


def running_loop() -> Any:
    """Return the asyncio loop that runs on this stack, without loading asyncio."""
    return getattr(sys.modules.get("asyncio"), "_get_running_loop", _nothing)()


def leave_asyncio() -> Callable[[], None]:
    """Leave this stack's asyncio loop and task, if it runs in one; return what enters them again.

    Asyncio keeps one of each per thread; here each stack has its own.
    """
    loop = running_loop()
    if loop is None:
        return _nothing
    from asyncio import _set_running_loop, current_task
    from asyncio.tasks import _enter_task, _leave_task

    task = current_task(loop)
    if task is not None:
        _leave_task(loop, task)
    _set_running_loop(None)

    def enter() -> None:
        _set_running_loop(loop)
        if task is not None:
            _enter_task(loop, task)

    return enter


def _nothing() -> None: ...


def _check_may_wait(runtime: Runtime, what: object) -> None:
    """Raise an error where no stack can wait, and when the run is over."""
    if get_ident() != runtime.runners.thread or getpid() != runtime.runners.process:
        place = "thread" if getpid() == runtime.runners.process else "process"
        raise UnsupportedError(
            f"a {place} that a node has started waits for {what}, which takes simulated time: only "
            "callbacks, constructors and tasks can wait; use call_async with add_done_callback, "
            f"or let a callback wait and pass the result to the {place}"
        )
    if runtime.ending.unwinding or runtime.programs.present.ended:
        _refuse(runtime)
    if runtime.event.handle is None:
        raise UnsupportedError(
            f"code outside of all callbacks cannot wait for {what}: a stop function only reads; "
            "with a Simulation, use sim.call(…), or run the simulation until then"
        )


def _end_event_part(runtime: Runtime) -> None:
    """Record the current event as SUSPENDED, unless it is quiet and has no outputs."""
    event = runtime.event
    if event.quiet and not runtime.dispatcher.has_outputs():
        event.quiet = False
        event.flags = 0
        return
    event.flags |= _SUSPENDED
    runtime.dispatcher.end_event()


@contextmanager
def suspended_event(runtime: Runtime) -> Iterator[None]:
    """Let other events run on this stack between two parts of the current event."""
    event, programs, dispatcher = runtime.event, runtime.programs, runtime.dispatcher
    whose = event.handle, event.entity, event.node
    constructing, on_end = programs.constructing, event.on_end
    _end_event_part(runtime)
    event.on_end = None
    try:
        yield
    finally:
        event.handle, event.entity, event.node = whose
        for observer in dispatcher.node_observers:
            observer.node_entered(event.node, is_made=False)
        event.kind, event.input_hash = _RESUME, 0
        event.cause_event, event.cause_output = runtime.loop.events - 1, 0
        programs.constructing, event.on_end = constructing, on_end
        event.quiet = True
        for observer in dispatcher.resume_observers:
            observer.resumed()


def _refuse(runtime: Runtime) -> NoReturn:
    count_refused_wait(runtime)
    raise RunEnded


def abandon(stack: greenlet) -> None:
    """Keep a stack for ever: nothing is raised in it, and nothing in it is collected."""
    _abandoned.append(stack)


def count_refused_wait(runtime: Runtime) -> None:
    """Count the waits of a stack that goes on although the run is over; abandon it in the end."""
    runtime.ending.refused += 1
    if runtime.ending.refused > _PATIENCE and getcurrent() is not runtime.runners.main:
        runtime.ending.refused = 0
        runtime.dispatcher.end_event()
        abandon(getcurrent())
        runtime.programs.host.enter()
        assert runtime.runners.main is not None
        runtime.runners.main.switch()


def _hold_group(runtime: Runtime) -> object:
    """Keep the group of a blocked callback busy, as an executor does; return it."""
    event = runtime.event
    wrapper: Any = getattr(event.handle, "wrapper", None)
    group = getattr(wrapper, "callback_group", None)
    if (
        event.on_end is None
        and group is not None
        and not groups.is_custom(group)  # that of a callback is held already
        and not groups.is_busy(group, wrapper)
    ):
        groups.begin(group, wrapper)
        event.on_end = lambda: runtime.groups.end(group, wrapper)
    return group


def end_blocked(runtime: Runtime) -> None:
    """Unwind every blocked call at the end of a run: ``finally`` blocks run."""
    runtime.ending.unwinding = True
    runtime.loop.halt()
    here = getcurrent()
    for blocked in list(runtime.runners.blocked):
        runtime.runners.waiting.append(here)
        blocked.stack.switch()
    for runner in runtime.runners.waiting:
        if runner is not here and not runner.dead:
            runner.throw(RunEnded)
    runtime.runners.waiting.clear()


class SimEvent:
    """Stands in for ``threading.Event`` in rclpy."""

    def __init__(self, runtime: Runtime, what: str = "an event to be set") -> None:
        self._runtime = runtime
        self._what = what
        self._set = False
        self._waits: list[BlockedCall] = []

    def is_set(self) -> bool:
        return self._set

    def set(self) -> None:
        self._set = True
        waits, self._waits = self._waits, []
        for blocked in waits:
            blocked.wake()

    set.__qualname__ = "Rate"  # the timer of a Rate has it as its callback, and is named after it

    def clear(self) -> None:
        self._set = False

    def wait(self, timeout: float | None = None) -> bool:
        return self.wait_ns(None if timeout is None else waiting_ns(timeout))

    def wait_ns(self, timeout_ns: int | None) -> bool:
        """Wait with a timeout in nanoseconds."""
        if not self._set:
            wait(self._runtime, self._what, until=self._waits.append, for_ns=timeout_ns)
            self._waits = [blocked for blocked in self._waits if blocked.waiting]
        return self._set


class EventSetter:
    """A future's done callback that sets an event at once, without becoming a task."""

    def __init__(self, event: SimEvent) -> None:
        self._event = event

    def __call__(self, future: Any) -> None:
        self._event.set()


_SHUTDOWN_NS = 10_000_000_000
_SHORTEST_SLEEP_NS = 1_000_000
_RATE = (
    "the next period of a Rate, which is a timer of its node: an executor has to spin the node "
    "meanwhile, in another thread"
)
_real_sleep = copy_of(time.sleep)
runtimes: list[Runtime] = []
"""Those of the runs in this process, or in the process that forked it."""


def calling_runtime() -> Runtime | None:
    """Return the runtime of the calling code; None outside of nodes, in real threads and in other
    processes."""
    runtime = runtimes[-1] if runtimes else None
    if (
        runtime is None
        or get_ident() != runtime.runners.thread
        or getpid() != runtime.runners.process
    ):
        return None
    return runtime if runtime.event.handle is not None or runtime.programs.importing else None


def _sleep(seconds: float) -> None:
    """Replace ``time.sleep`` during a run."""
    library = present_import()
    if library is not None:
        library.passed_ns += int(seconds * 1_000_000_000)
    runtime = calling_runtime()
    if runtime is None or runtime.event.handle is None or library is not None:
        _real_sleep(seconds)
        return
    if seconds < 0:
        raise ValueError("sleep length must be non-negative")
    frame = sys._getframe(1)
    if frame.f_globals.get("__name__") == "subprocess":
        sleep_for_process(seconds, _real_sleep, frame)
        return
    for_ns = waiting_ns(seconds)
    if runtime.ending.unwinding and runtime.ending.shutdown_ns < _SHUTDOWN_NS:
        # Time stands still, but destroy_node and ``finally`` may sleep as long as ros2 launch
        # waits between SIGINT and SIGKILL.
        runtime.ending.shutdown_ns += max(for_ns, _SHORTEST_SLEEP_NS)
        return
    wait(runtime, f"{seconds} s to pass", for_ns=for_ns)


@contextmanager
def simulated_waiting(runtime: Runtime, seed: int) -> Iterator[None]:
    """Simulate ``time.sleep`` and the modules that rclpy waits with, within the ``with`` block."""
    import rclpy.action.client
    import rclpy.client
    import rclpy.node
    import rclpy.task
    import rclpy.timer

    def now() -> float:
        return runtime.loop.now_ns / 1_000_000_000

    replaced = [
        (rclpy.node, "time", module_with(time, time=now, monotonic=now, sleep=_sleep)),
        (rclpy.client, "time", module_with(time, time=now, monotonic=now, sleep=_sleep)),
        (rclpy.client, "threading", _threading(runtime, "the response to a service call")),
        (rclpy.timer, "threading", _threading(runtime, _RATE)),
        (rclpy.action.client, "threading", _threading(runtime, "an answer of an action server")),
        # Its lock is never held while waiting.
        (rclpy.task, "threading", module_with(threading, Lock=threading.Lock)),
        (rclpy.action.client, "uuid", module_with(uuid, uuid4=_goal_ids(runtime.event, seed))),
    ]
    with ExitStack() as stack:
        for module, name, value in replaced:
            if hasattr(module, name):  # releases differ in what they import
                replace_attribute(stack, module, name, value)
        redirected = Redirected(time.sleep, _sleep)  # type: ignore[arg-type]
        stack.callback(redirected.restore)
        runtimes.append(runtime)
        stack.callback(runtimes.remove, runtime)
        yield


def _goal_ids(event: CurrentEvent, seed: int) -> Callable[[], uuid.UUID]:
    """Return a ``uuid4`` that draws goal ids from a random stream of the current node."""
    streams: dict[str, random.Random] = {}

    def uuid4() -> uuid.UUID:
        name = event.node.fully_qualified_name if event.node is not None else ""
        stream = streams.get(name)
        if stream is None:
            stream = streams[name] = random.Random(f"goal ids {seed} {name}")
        return uuid.UUID(int=stream.getrandbits(128), version=4)

    return uuid4


def _threading(runtime: Runtime, what: str) -> ModuleType:
    return module_with(
        threading,
        Event=partial(SimEvent, runtime, what),
        Lock=threading.Lock,
        RLock=threading.RLock,
    )
