"""Threads that user code starts run as cooperative ones, in the one thread of the simulation.

A thread is a stack of its own that runs until it blocks or spins; then somebody else goes on. As
CPython's, ``Thread.start`` waits until the thread has begun, and goes on when that blocks; a thread
of ``start_new_thread`` begins after the event that started it. ``threading``, ``queue`` and
``concurrent.futures`` stay what they are: only ``Thread.start`` and its like, and the locks below
everything, are exchanged while a run lasts. What real threads (of libraries in C) start or lock
stays real.
"""

from __future__ import annotations

import _thread
import _threading_local
import concurrent.futures
import concurrent.futures._base as futures_base
import concurrent.futures.thread as futures_thread
import itertools
import logging
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import FrameType, SimpleNamespace
from typing import Any

from greenlet import getcurrent, greenlet

from rsltrace.adapters.rclpy.stacks.blocking_calls import calling_runtime, wait
from rsltrace.adapters.rclpy.stacks.entry_starts import ConstructionEvent
from rsltrace.adapters.rclpy.stacks.locks import PoolLock, SimLock, SimRLock
from rsltrace.adapters.rclpy.stacks.runtime import BlockedCall, RunEnded, Runtime
from rsltrace.guard.callers import is_user_file, module_of
from rsltrace.guard.guard import engaged
from rsltrace.guard.libraries import present_import
from rsltrace.guard.virtual.processors import PROCESSORS
from rsltrace.simulation.middleware.entity import Runnable, on_no_executor
from rsltrace.simulation.middleware.interface import source_of
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.model.finding import Mode, Source
from rsltrace.trace.model.texts import patience_ns

_NS_PER_S = 1_000_000_000
_FIRST_IDENT = 1_000_001
_FIRST_OF_IMPORTS = 10_001
_real_get_ident = _thread.get_ident
_real_start_new_thread = _thread.start_new_thread
_Thread = threading.Thread
_pool_worker = futures_thread._worker
_real = {name: getattr(_Thread, name) for name in ("start", "join", "is_alive")}


class SimThread:
    """One thread of the simulation. It is dispatched once, to begin."""

    def __init__(
        self,
        stacks: Runtime,
        body: Callable[[], object],
        name: str,
        *,
        daemon: bool,
        thread: threading.Thread | None = None,
    ) -> None:
        self.stacks = stacks
        self.thread = thread
        self.name = name
        self.daemon = daemon
        self.program = stacks.programs.present
        self.ident = _FIRST_IDENT + stacks.threads.count
        stacks.threads.count += 1
        self.stack: greenlet | None = None
        self.ended = False
        self.announced = True
        self.node = stacks.event.node
        self.entity_id = stacks.domain.entities.new_id()
        stacks.domain.entities.pending.append(self)
        self._body: Callable[[], object] | None = body
        self._joining: list[BlockedCall] = []
        self._starting: BlockedCall | None = None
        self._cause = (
            stacks.loop.events,
            stacks.dispatcher.note(OutputKind.TASK, self.entity_id, 3),
        )
        self._input_hash = stacks.event.input_hash
        stacks.threads.alive[self] = None
        stacks.loop.tasks.append(self)

    def overtake(self) -> None:
        """Begin before those of the same process that were woken and have not gone on yet.

        As in CPython, where whoever starts a thread waits for it at once: a new thread is there
        sooner than the kernel has woken another.
        """
        tasks = self.stacks.loop.tasks
        woken: list[Any] = []
        tasks.pop()
        while len(tasks) and self._goes_on_later(tasks[-1]):
            woken.append(tasks.pop())
        tasks.extend((self, *reversed(woken)))

    # -- the loop's view -------------------------------------------------------------------------

    def _goes_on_later(self, task: object) -> bool:
        return isinstance(task, BlockedCall) and task.program is self.program

    def dispatch(self) -> None:
        """Run the thread until it ends or blocks for the first time, as one event."""
        if self.ended or self.program.ended:
            self.end()
            return
        held = self.program.held
        if held is None and self.node is not None:
            held = self.node.held
        if held is not None:  # it begins when its process does not hang any more
            held.append(self)
            return
        stacks = self.stacks
        stacks.runners.waiting.append(getcurrent())
        self.stack = greenlet(self._run)
        stacks.threads.by_stack[self.stack] = self
        self.stack.switch()

    def _run(self) -> None:
        stacks = self.stacks
        if self.program is not stacks.programs.present:
            self.program.enter()
        cause_event, cause_output = self._cause
        stacks.dispatcher.execute(
            ConstructionEvent(self.describe, self.program.entry),
            self.entity_id,
            self.node,
            int(EventKind.TASK),
            self._call,
            (),
            cause_event,
            cause_output,
            self._input_hash,
        )
        stacks.programs.leave()
        stacks.runners.step_aside()

    def _call(self) -> None:
        from rclpy.executors import ExternalShutdownException

        body, self._body = self._body, None
        assert body is not None
        if self._starting is not None:
            self._starting.wake()
        try:
            body()
        except (RunEnded, SystemExit, ExternalShutdownException):
            pass
        except KeyboardInterrupt:
            if not self.stacks.ending.closing:
                raise
        finally:
            self.end()

    def wait_for_begin(self) -> None:
        """Let the thread run until it blocks, or ends: whoever starts it goes on after that.

        Where nobody can wait (while modules are imported, when the run is over) it begins later.
        """
        stacks = self.stacks
        if stacks.event.handle is None or stacks.ending.unwinding or self.program.ended:
            return

        def begun(blocked: BlockedCall) -> None:
            self._starting = blocked

        wait(stacks, f"thread {self.name} to begin", until=begun, quiet=True)

    def end(self) -> None:
        """Take note that the thread has ended: whoever joins it goes on."""
        self.ended = True
        self._body = None
        self.stacks.threads.alive.pop(self, None)
        if self.stack is not None:
            self.stacks.threads.by_stack.pop(self.stack, None)
        for blocked in self._joining:
            blocked.wake()

    def dismiss(self) -> None:
        """Let the worker of a pool end when it has done its work, as Python does at its end."""
        if getattr(self.thread, "_target", None) is _pool_worker:
            pool = self.thread._args[0]()  # type: ignore[union-attr]
            if pool is not None:
                pool.shutdown(wait=False)

    def describe(self) -> str:
        where = self.program.name if self.node is None else self.node.fully_qualified_name
        return f"{where}: thread {self.name}"

    def join(self, timeout: float | None) -> None:
        """Wait in simulated time until the thread has ended."""
        if not self.ended:
            for_ns = None if timeout is None else max(patience_ns(timeout), 0)
            what = f"thread {self.name} to end"
            wait(
                self.stacks,
                what,
                until=self._joining.append,
                for_ns=for_ns,
                patient=self.is_patient,
            )
            self._joining = [blocked for blocked in self._joining if blocked.waiting]

    def is_patient(self) -> bool:
        """Return whether the thread waits for what may never come, so that a join may, too."""
        own = [blocked for blocked in self.stacks.runners.blocked if blocked.stack is self.stack]
        return any(blocked.is_patient() for blocked in own)

    def runnable(self) -> Runnable:
        return on_no_executor(self.node, self.describe())

    # -- the trace -------------------------------------------------------------------------------

    def settle(self) -> bool:
        return True

    def entity(self) -> Entity:
        node = self.node.entity_id if self.node is not None else 0
        now_ns = self.stacks.loop.now_ns
        source = source_of(
            getattr(self.thread, "_target", None) or getattr(self.thread, "run", None)
        )
        detail: dict[str, object] = {"source": source} if source else {}
        return Entity(self.entity_id, node, EntityKind.THREAD, self.name, "", now_ns, detail)


# -- what stands in for Python's own functions -------------------------------------------------


def _start(self: Any) -> None:
    stacks = calling_runtime()
    if stacks is None or not getattr(self, "_initialized", False):
        _real["start"](self)
        return
    if self._started.is_set() or "_rsltrace" in self.__dict__:
        raise RuntimeError("threads can only be started once")
    library = present_import()
    if library is not None and isinstance(self, threading.Timer):
        # Most warn of an import that takes long (to build a cache, the first time).
        self.__dict__["_rsltrace_late"] = partial(_begin, stacks, self)
        library.at_end.append(partial(_start_late, self, sys._getframe(1)))
        return
    if library is not None:
        _tell_of_import(self, sys._getframe(1))
    _begin(stacks, self)


def _tell_of_import(thread: Any, frame: FrameType) -> None:
    """Report a thread that a library starts while it is imported: another time it may not."""
    guard = engaged()
    if guard is not None and guard.mode(Source.THREAD, frame) is not Mode.ALLOW:
        call = f"threading.Thread.start() while {module_of(frame)} is imported"
        guard.found(Source.THREAD, Mode.WARN, call, thread.name, frame)


def _start_late(timer: Any, frame: FrameType | None = None) -> None:
    """Start a timer of an import that is over, unless somebody has cancelled it by now."""
    begin = timer.__dict__.pop("_rsltrace_late", None)
    if begin is None:
        return
    if timer.finished.is_set():
        timer._started.set()
        timer._ident = timer._native_id = 0
        _mark_stopped(timer)
    else:
        _tell_of_import(timer, frame or sys._getframe(1))
        begin()


def _begin(stacks: Runtime, self: Any) -> None:
    def body() -> None:
        try:
            self.run()
        except (RunEnded, SystemExit):
            raise
        except BaseException:
            if threading.excepthook is not _default_hook:
                _tell_hook(self)
                return
            raise
        finally:
            _mark_stopped(self)

    thread = SimThread(stacks, body, self.name, daemon=self.daemon, thread=self)
    self._rsltrace = thread
    self._ident = self._native_id = thread.ident
    threading._active[thread.ident] = self  # type: ignore[attr-defined]
    self._started.set()
    thread.overtake()
    thread.wait_for_begin()


_default_hook = threading.excepthook


def _tell_hook(thread: Any) -> None:
    threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), thread)))


def _mark_stopped(thread: Any) -> None:
    """Let the real ``Thread`` know, for whoever asks after the run."""
    threading._active.pop(thread._ident, None)  # type: ignore[attr-defined]
    if hasattr(thread, "_is_stopped"):
        thread._is_stopped = True
    make_handle = getattr(threading, "_make_thread_handle", None)  # from Python 3.13 on
    if make_handle is not None:
        thread._handle = make_handle(thread._ident)  # its own was never started
        thread._handle._set_done()


def _join(self: Any, timeout: float | None = None) -> None:
    _start_late(self)
    thread: SimThread | None = self.__dict__.get("_rsltrace")
    if thread is None or calling_runtime() is not thread.stacks:
        if thread is None:
            _real["join"](self, timeout)
        return
    if thread.stack is getcurrent():
        raise RuntimeError("cannot join current thread")
    thread.join(timeout)


def _is_alive(self: Any) -> bool:
    if "_rsltrace_late" in self.__dict__:
        return not self.finished.is_set()
    thread: SimThread | None = self.__dict__.get("_rsltrace")
    return bool(_real["is_alive"](self)) if thread is None else not thread.ended


def _get_ident() -> int:
    stacks = calling_runtime()
    if stacks is not None and stacks.threads.by_stack:
        thread = stacks.threads.by_stack.get(getcurrent())
        if thread is not None:
            return thread.ident
    return _real_get_ident()


def _start_new_thread(
    function: Callable[..., object], args: tuple[Any, ...], kwargs: dict[str, Any] | None = None
) -> int:
    stacks = calling_runtime()
    if stacks is None:
        return _real_start_new_thread(function, args, kwargs or {})
    name = getattr(function, "__qualname__", "function")
    thread = SimThread(stacks, lambda: function(*args, **(kwargs or {})), name, daemon=True)
    return thread.ident


@contextmanager
def cooperative_threads(stacks: Runtime) -> Iterator[None]:
    """Make the threads that user code starts cooperative ones within the ``with`` block."""

    def now() -> float:
        return stacks.loop.now_ns / _NS_PER_S

    replaced: list[tuple[Any, str, Any]] = [
        (_Thread, "start", _start),
        (_Thread, "join", _join),
        (_Thread, "is_alive", _is_alive),
        (threading, "Lock", SimLock),
        (threading, "_allocate_lock", SimLock),
        (threading, "_CRLock", SimRLock),
        (threading, "get_ident", _get_ident),
        (threading, "local", _threading_local.local),
        (threading, "_time", now),
        (threading, "_counter", _numbers()),
        (_thread, "start_new_thread", _start_new_thread),
        (_thread, "start_new", _start_new_thread),
        (queue, "SimpleQueue", queue._PySimpleQueue),  # type: ignore[attr-defined]
        (queue, "time", now),
        (futures_base, "time", SimpleNamespace(monotonic=now)),
        (concurrent.futures.ThreadPoolExecutor, "_counter", staticmethod(_numbers(0))),
        (
            futures_thread,
            "_global_shutdown_lock",
            PoolLock(futures_thread._global_shutdown_lock),
        ),
        (futures_thread, "os", SimpleNamespace(cpu_count=_count, process_cpu_count=_count)),
    ]
    with ExitStack() as stack:
        rebound = {id(getattr(place, name)): value for place, name, value in replaced[3:]}
        for place, name, value in replaced:
            stack.callback(setattr, place, name, getattr(place, name))
            setattr(place, name, value)
        _rebind(stack, rebound)
        _number(stack, _Thread)
        _number(stack, futures_base.Future)
        futures_base.LOGGER.addFilter(_is_news)
        stack.callback(futures_base.LOGGER.removeFilter, _is_news)
        try:
            yield
        finally:
            for thread in stacks.threads.alive:
                if thread.thread is not None:
                    _mark_stopped(thread.thread)


def _count() -> int:
    return PROCESSORS


def _numbers(first: int = 1) -> Callable[[], int]:
    """Return what numbers threads: those of a library's import apart from the run's."""
    own, of_imports = itertools.count(first), itertools.count(_FIRST_OF_IMPORTS)
    return lambda: next(own if present_import() is None else of_imports)


def _is_news(record: logging.LogRecord) -> bool:
    """Say whether a log record of a thread pool is more than the end of a run in its workers."""
    return not (record.exc_info and record.exc_info[0] is RunEnded)


def _number(stack: ExitStack, cls: Any) -> None:
    """Hash the objects of a class by the order of creation: the library keeps them in sets."""
    number = _numbers()
    real_init = cls.__init__

    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:  # noqa: N807
        if calling_runtime() is not None:
            self._rsltrace_number = number()
        real_init(self, *args, **kwargs)

    def __hash__(self: Any) -> int:  # noqa: N807
        return self.__dict__.get("_rsltrace_number") or object.__hash__(self)

    cls.__init__, cls.__hash__ = __init__, __hash__
    stack.callback(setattr, cls, "__init__", real_init)
    stack.callback(delattr, cls, "__hash__")


def _rebind(stack: ExitStack, values: dict[int, Any]) -> None:
    """Exchange what users' modules have bound before the run: ``from threading import Lock``."""
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if not file or not is_user_file(file):
            continue
        for name, value in list(vars(module).items()):
            if callable(value) and id(value) in values:
                stack.callback(setattr, module, name, value)
                setattr(module, name, values[id(value)])


__all__ = ["SimThread", "cooperative_threads"]
