"""Threads of user code run cooperatively, in the one real thread of the simulation.

A thread is a stack that runs until it blocks or spins. As in CPython, ``Thread.start`` waits until
the thread has begun; a thread of ``start_new_thread`` begins after the event that started it. In
``threading``, ``queue`` and ``concurrent.futures`` only ``Thread.start`` and similar functions and
the locks are replaced during a run. Threads and locks of C libraries stay real.
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

from rsltrace.adapters.rclpy.concurrency.blocking_calls import calling_runtime, wait
from rsltrace.adapters.rclpy.concurrency.entry_starts import ConstructionEvent
from rsltrace.adapters.rclpy.concurrency.locks import PoolLock, SimLock, SimRLock
from rsltrace.adapters.rclpy.concurrency.runtime import BlockedCall, RunEnded, Runtime
from rsltrace.guard import loading
from rsltrace.guard.callers import is_user_file, module_of
from rsltrace.guard.guard import engaged
from rsltrace.guard.libraries import present_import
from rsltrace.guard.redirect import replace_attribute
from rsltrace.guard.virtual.processors import PROCESSORS
from rsltrace.simulation.middleware.entity import Runnable, on_no_executor
from rsltrace.simulation.middleware.interface import callback_source
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource
from rsltrace.trace.model.texts import waiting_ns

_NS_PER_S = 1_000_000_000
_FIRST_IDENT = 1_000_001
_FIRST_OF_IMPORTS = 10_001
_real_get_ident = _thread.get_ident
_real_start_new_thread = _thread.start_new_thread
_real_enumerate = threading.enumerate
_Thread = threading.Thread
_identity: Callable[[object], int] = object.__hash__
"""Identifies objects like ``id``, but raises no audit event."""
_pool_worker = futures_thread._worker
_real = {name: getattr(_Thread, name) for name in ("start", "join", "is_alive")}


class SimThread:
    """A simulated thread; the loop dispatches it once, to begin."""

    def __init__(
        self,
        runtime: Runtime,
        body: Callable[[], object],
        name: str,
        *,
        daemon: bool,
        thread: threading.Thread | None = None,
    ) -> None:
        self.runtime = runtime
        self.thread = thread
        self.name = name
        self.daemon = daemon
        self.program = runtime.programs.present
        self.ident = _FIRST_IDENT + runtime.threads.count
        runtime.threads.count += 1
        self.stack: greenlet | None = None
        self.ended = False
        self.announced = True
        self.node = runtime.event.node
        self.entity_id = runtime.domain.entities.new_id()
        runtime.domain.entities.pending.append(self)
        self._body: Callable[[], object] | None = body
        self._joining: list[BlockedCall] = []
        self._starting: BlockedCall | None = None
        self._cause = (
            runtime.loop.events,
            runtime.dispatcher.note(OutputKind.TASK, self.entity_id, 3),
        )
        self._input_hash = runtime.event.input_hash
        runtime.threads.alive[self] = None
        runtime.loop.tasks.append(self)

    def overtake(self) -> None:
        """Begin before threads of the same process that were woken and have not run yet.

        As in CPython, where the starter waits for a new thread at once: it begins before the kernel
        has woken another.
        """
        tasks = self.runtime.loop.tasks
        woken: list[Any] = []
        tasks.pop()
        while len(tasks) and self._was_woken(tasks[-1]):
            woken.append(tasks.pop())
        tasks.extend((self, *reversed(woken)))

    # -- the loop's view -------------------------------------------------------------------------

    def _was_woken(self, task: object) -> bool:
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
        runtime = self.runtime
        runtime.runners.waiting.append(getcurrent())
        self.stack = greenlet(self._run)
        runtime.threads.by_stack[self.stack] = self
        self.stack.switch()

    def _run(self) -> None:
        runtime = self.runtime
        if self.program is not runtime.programs.present:
            self.program.enter()
        cause_event, cause_output = self._cause
        runtime.dispatcher.execute(
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
        runtime.programs.leave()
        runtime.runners.step_aside()

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
            if not self.runtime.ending.closing:
                raise
        finally:
            self.end()

    def wait_for_begin(self) -> None:
        """Let the thread run until it blocks or ends, before its starter goes on.

        If the starter cannot wait (at import, or after the run) the thread begins later.
        """
        runtime = self.runtime
        if runtime.event.handle is None or runtime.ending.unwinding or self.program.ended:
            return

        def begun(blocked: BlockedCall) -> None:
            self._starting = blocked

        wait(runtime, f"thread {self.name} to begin", until=begun, quiet=True)

    def end(self) -> None:
        """Mark the thread as ended, and wake the threads that join it."""
        self.ended = True
        self._body = None
        self.runtime.threads.alive.pop(self, None)
        if self.stack is not None:
            self.runtime.threads.by_stack.pop(self.stack, None)
        for blocked in self._joining:
            blocked.wake()

    def dismiss(self) -> None:
        """Let the worker of a pool end after its work, as Python does at exit."""
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
            for_ns = None if timeout is None else max(waiting_ns(timeout), 0)
            what, until = f"thread {self.name} to end", self._joining.append
            wait(self.runtime, what, until=until, for_ns=for_ns, patient=self.is_patient)
            self._joining = [blocked for blocked in self._joining if blocked.waiting]

    def is_patient(self) -> bool:
        """Return whether the thread may wait for ever, so that a join may, too."""
        own = [blocked for blocked in self.runtime.runners.blocked if blocked.stack is self.stack]
        return any(blocked.is_patient() for blocked in own)

    def runnable(self) -> Runnable:
        return on_no_executor(self.node, self.describe())

    # -- the trace -------------------------------------------------------------------------------

    def settle(self) -> bool:
        return True

    def entity(self) -> Entity:
        node = self.node.entity_id if self.node is not None else 0
        now_ns = self.runtime.loop.now_ns
        source = callback_source(
            getattr(self.thread, "_target", None) or getattr(self.thread, "run", None)
        )
        detail: dict[str, object] = {"source": source} if source else {}
        return Entity(self.entity_id, node, EntityKind.THREAD, self.name, "", now_ns, detail)


# -- replacements of Python's functions --------------------------------------------------------


def _start(self: Any) -> None:
    runtime = calling_runtime()
    if runtime is None or not getattr(self, "_initialized", False):
        _real["start"](self)
        return
    if self._started.is_set() or "_rsltrace" in self.__dict__:
        raise RuntimeError("threads can only be started once")
    library = present_import()
    if library is not None and isinstance(self, threading.Timer):
        # Most warn of a slow import (that builds a cache, the first time).
        self.__dict__["_rsltrace_late"] = partial(_begin, runtime, self)
        library.at_end.append(partial(_start_late, self, sys._getframe(1)))
        return
    if library is not None:
        _report_import_thread(self, sys._getframe(1))
    _begin(runtime, self)


def _report_import_thread(thread: Any, frame: FrameType) -> None:
    """Report a thread that a library starts at import: the next import may start none."""
    guard = engaged()
    if guard is not None and guard.mode(NondeterminismSource.THREAD, frame) is not GuardMode.ALLOW:
        call = f"threading.Thread.start() while {module_of(frame)} is imported"
        guard.report(NondeterminismSource.THREAD, GuardMode.WARN, call, thread.name, frame)


def _start_late(timer: Any, frame: FrameType | None = None) -> None:
    """Start a timer of an import that is over, unless it was cancelled."""
    begin = timer.__dict__.pop("_rsltrace_late", None)
    if begin is None:
        return
    if timer.finished.is_set():
        timer._started.set()
        timer._ident = timer._native_id = 0
        _mark_stopped(timer)
    else:
        _report_import_thread(timer, frame or sys._getframe(1))
        begin()


def _begin(runtime: Runtime, self: Any) -> None:
    def body() -> None:
        try:
            self.run()
        except (RunEnded, SystemExit):
            raise
        except BaseException:
            if threading.excepthook is not _default_hook:
                _call_excepthook(self)
                return
            raise
        finally:
            _mark_stopped(self)

    thread = SimThread(runtime, body, self.name, daemon=self.daemon, thread=self)
    self._rsltrace = thread
    self._ident = self._native_id = thread.ident
    threading._active[thread.ident] = self  # type: ignore[attr-defined]
    self._started.set()
    thread.overtake()
    thread.wait_for_begin()


_default_hook = threading.excepthook


def _call_excepthook(thread: Any) -> None:
    threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), thread)))


def _mark_stopped(thread: Any) -> None:
    """Mark the real ``Thread`` as stopped, for code that asks after the run."""
    threading._active.pop(thread._ident, None)  # type: ignore[attr-defined]
    if hasattr(thread, "_is_stopped"):
        thread._is_stopped = True
    make_handle = getattr(threading, "_make_thread_handle", None)  # from Python 3.13 on
    if make_handle is not None:
        handle = make_handle(thread._ident)  # its own was never started
        handle._set_done()
        setattr(thread, "_handle" if hasattr(thread, "_handle") else "_os_thread_handle", handle)


def _join(self: Any, timeout: float | None = None) -> None:
    _start_late(self)
    thread: SimThread | None = self.__dict__.get("_rsltrace")
    if thread is None or calling_runtime() is not thread.runtime:
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
    runtime = calling_runtime()
    if runtime is not None and runtime.threads.by_stack:
        thread = runtime.threads.by_stack.get(getcurrent())
        if thread is not None:
            return thread.ident
    return _real_get_ident()


def _start_new_thread(
    function: Callable[..., object], args: tuple[Any, ...], kwargs: dict[str, Any] | None = None
) -> int:
    runtime = calling_runtime()
    if runtime is None:
        return _real_start_new_thread(function, args, kwargs or {})
    name = getattr(function, "__qualname__", "function")
    thread = SimThread(runtime, lambda: function(*args, **(kwargs or {})), name, daemon=True)
    return thread.ident


def _enumerate() -> list[threading.Thread]:
    """Return the threads of nodes: those of who has started the run come and go."""
    threads = _real_enumerate()
    if calling_runtime() is None:
        return threads
    main = threading.main_thread()
    return [thread for thread in threads if thread is main or hasattr(thread, "_rsltrace")]


@contextmanager
def cooperative_threads(runtime: Runtime) -> Iterator[None]:
    """Simulate the threads that user code starts within the ``with`` block."""

    def now() -> float:
        return runtime.loop.now_ns / _NS_PER_S

    replaced: list[tuple[Any, str, Any]] = [
        (_Thread, "start", _start),
        (_Thread, "join", _join),
        (_Thread, "is_alive", _is_alive),
        (threading, "Lock", SimLock),
        (threading, "_allocate_lock", SimLock),
        (threading, "_CRLock", SimRLock),
        (threading, "get_ident", _get_ident),
        (threading, "enumerate", _enumerate),
        (threading, "active_count", lambda: len(_enumerate())),
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
        rebound = {
            _identity(real): value
            for place, name, value in replaced[3:]
            if callable(real := getattr(place, name))
        }
        outside = [
            (name, getattr(place, name)) for place, name, _ in replaced if place is threading
        ]
        for place, name, value in replaced:
            replace_attribute(stack, place, name, value)
        loading.apart.append(partial(_outside_of_runs, outside))
        stack.callback(loading.apart.pop)
        _rebind(stack, rebound)
        _number(stack, _Thread)
        _number(stack, futures_base.Future)
        futures_base.LOGGER.addFilter(_is_news)
        stack.callback(futures_base.LOGGER.removeFilter, _is_news)
        try:
            yield
        finally:
            for thread in runtime.threads.alive:
                if thread.thread is not None:
                    _mark_stopped(thread.thread)


@contextmanager
def _outside_of_runs(values: list[tuple[str, Any]]) -> Iterator[None]:
    """Let a module have the real attributes of ``threading``, to bind and to derive from."""
    with ExitStack() as stack:
        for name, value in values:
            replace_attribute(stack, threading, name, value)
        yield


def _count() -> int:
    return PROCESSORS


def _numbers(first: int = 1) -> Callable[[], int]:
    """Return a counter of threads, with other numbers for those of a library's import."""
    own, of_imports = itertools.count(first), itertools.count(_FIRST_OF_IMPORTS)
    return lambda: next(own if present_import() is None else of_imports)


def _is_news(record: logging.LogRecord) -> bool:
    """Return whether a thread pool's log record is about anything but the end of the run."""
    return not (record.exc_info and record.exc_info[0] is RunEnded)


def _number(stack: ExitStack, cls: Any) -> None:
    """Hash the objects of a class by their creation order: the library keeps them in sets."""
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
    """Replace names that modules of user code imported before the run."""
    for module in list(sys.modules.values()):
        attributes = getattr(module, "__dict__", {})
        if values.keys().isdisjoint(map(_identity, attributes.values())):
            continue  # nearly all; whose a file is may take a look at all installed packages
        if is_user_file(getattr(module, "__file__", None) or "<frozen"):
            for name, value in list(attributes.items()):
                if _identity(value) in values:
                    replace_attribute(stack, module, name, values[_identity(value)])
