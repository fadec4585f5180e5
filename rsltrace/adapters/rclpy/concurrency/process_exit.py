"""``os._exit``, ``os.abort``, signals to the own process and the like, called by nodes.

During a run they end one main with its threads or, called by a node that the job constructs, the
run. As natively, no ``finally`` block and no exit handler runs: the stacks are abandoned. The trace
is complete, and names the caller.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]
import os
import posix
import signal
import sys
import threading
from _thread import get_ident
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn

from greenlet import getcurrent

from rsltrace.adapters.rclpy.concurrency.blocking_calls import (
    abandon,
    calling_runtime,
    getpid,
    leave_asyncio,
    runtimes,
)
from rsltrace.adapters.rclpy.concurrency.mains import end_program, interrupt, shut_down
from rsltrace.adapters.rclpy.concurrency.runtime import RunEnded, Runtime
from rsltrace.errors import UnsupportedError
from rsltrace.guard.callers import is_user_file
from rsltrace.guard.process_ids import real_id
from rsltrace.guard.redirect import Redirected
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.events.failure import (
    RaisedException,
    exception_text,
    is_own_frame,
    user_traceback,
)
from rsltrace.terminal import tell
from rsltrace.trace.model.event import OutputKind

# Signal handlers: each main has its own, and rsltrace's stay in place. Ctrl-C, SIGTERM and SIGHUP
# end a run, whatever handlers its nodes set. Handlers for other signals (alarms) work until the run
# is over. A handler raises only in the code of nodes; if it interrupts rsltrace, it ends the run.

_SIGNALS_ENDING = frozenset((signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT))
_TIMERS = (signal.ITIMER_REAL, signal.ITIMER_VIRTUAL, signal.ITIMER_PROF)


class _SignalHandler:
    """A node's signal handler; it may interrupt any code."""

    def __init__(self, domain: Domain, handler: Callable[[int, FrameType | None], Any]) -> None:
        self._domain = domain
        self.handler = handler

    def __call__(self, number: int, frame: FrameType | None) -> None:
        loop, outcome = self._domain.loop, self._domain.outcome
        if loop.stopped is not None:
            return  # a fast alarm would never let the run end
        try:
            self.handler(number, frame)
        except BaseException as error:
            if _is_in_user_code(frame):
                raise
            label = f"the handler of {signal.Signals(number).name} that a node has set"
            said = RaisedException(
                error, label, "", loop.now_ns, user_traceback(error), exception_text(error)
            )
            outcome.error = outcome.error or said.as_error()
            loop.stop(Stop(f"{label} raised {said.kind}", outcome.error.exit_code))


def _is_in_user_code(frame: FrameType | None) -> bool:
    """Return whether an exception in a frame would pass through a node's code first."""
    while frame is not None and not is_own_frame(frame):
        file = frame.f_code.co_filename
        if not file.startswith("<") and is_user_file(file):
            return True
        frame = frame.f_back
    return False


@contextmanager
def own_signal_handlers(runtime: Runtime) -> Iterator[None]:
    """Give each main its own signal handlers within the ``with`` block."""
    before: dict[int, Any] = {}

    def set_handler(number: Any, handler: Any, /) -> Any:
        if calling_runtime() is not runtime:
            return real_set(number, handler)
        if getcurrent() in runtime.threads.by_stack:
            raise ValueError("signal only works in main thread of the main interpreter")
        if number not in _SIGNALS_ENDING:
            given = _SignalHandler(runtime.domain, handler) if callable(handler) else handler
            replaced = real_set(number, given)
            before.setdefault(number, replaced)
            return _node_handler(replaced)
        if not callable(handler) and handler not in (signal.SIG_DFL, signal.SIG_IGN):
            raise TypeError(
                "signal handler must be signal.SIG_IGN, signal.SIG_DFL, or a callable object"
            )
        replaced = get_handler(number)
        runtime.programs.present.signal_handlers[int(number)] = handler
        return replaced

    def get_handler(number: Any, /) -> Any:
        if calling_runtime() is runtime and number in runtime.programs.present.signal_handlers:
            return runtime.programs.present.signal_handlers[int(number)]
        return _node_handler(real_get(number))

    def set_wakeup(fd: int, /, **options: Any) -> Any:
        """Ignore asyncio's descriptor: signals that end a run are not for its loop."""
        return -1 if calling_runtime() is runtime else real_wakeup(fd, **options)

    with ExitStack() as stack:
        stack.callback(_put_back, before)
        armed = {timer for timer in _TIMERS if signal.getitimer(timer)[0]}
        stack.callback(_end_timers, armed)
        redirected = [
            Redirected(function, target)
            for function, target in (
                (_signal.signal, set_handler),
                (_signal.getsignal, get_handler),
                (_signal.set_wakeup_fd, set_wakeup),
            )
        ]
        for one in redirected:
            stack.callback(one.restore)
        real_set, real_get, real_wakeup = (one.real for one in redirected)
        yield


def _node_handler(handler: Any) -> Any:
    return handler.handler if isinstance(handler, _SignalHandler) else handler


def _end_timers(armed: set[int]) -> None:
    """End the alarms that nodes have set."""
    for timer in _TIMERS:
        if timer not in armed and signal.getitimer(timer)[0]:
            signal.setitimer(timer, 0)


def _put_back(handlers: dict[int, Any]) -> None:
    if threading.current_thread() is threading.main_thread():
        for number, handler in handlers.items():
            if handler is not None:  # None: it was not set from Python, which cannot set it again
                signal.signal(number, handler)


_DEADLY = (signal.SIGKILL, signal.SIGABRT)
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_real: dict[str, Callable[..., Any]] = {}
"""The functions before the run (perhaps the guard's)."""


@contextmanager
def own_process_ends(runtime: Runtime) -> Iterator[None]:
    """Let nodes end their simulated process only, within the ``with`` block."""
    targets: list[tuple[Any, Callable[..., Any]]] = [
        (posix._exit, _exit),  # a tool may have replaced those of os
        (posix.abort, _abort),
        (posix.kill, _kill),
        (posix.execv, _execv),
        (posix.execve, _execve),
        (_signal.raise_signal, _raise_signal),
    ]
    before = dict(_real)
    with ExitStack() as stack:
        stack.callback(_real.update, before)
        stack.callback(_real.clear)
        for function, target in targets:
            redirected = Redirected(function, target)
            stack.callback(redirected.restore)
            _real[function.__name__] = redirected.real
        yield


def _exit(status: int) -> None:
    runtime = _calling_node_runtime()
    if runtime is None:
        _real["_exit"](status)
    else:
        _end_process(runtime, f"os._exit({status})", status & 0xFF)


def _abort() -> None:
    runtime = _calling_node_runtime()
    if runtime is None:
        _real["abort"]()
    else:
        _end_process(runtime, "os.abort()", 128 + signal.SIGABRT)


def _kill(pid: int, number: int, /) -> None:
    pid = real_id(pid)
    runtime = _calling_node_runtime()
    if runtime is None or pid != getpid() or not _signalled(runtime, number, "os.kill"):
        _real["kill"](pid, number)


def _raise_signal(signalnum: int) -> None:
    runtime = _calling_node_runtime()
    if runtime is None or not _signalled(runtime, signalnum, "signal.raise_signal"):
        _real["raise_signal"](signalnum)


def _signalled(runtime: Runtime, number: int, call: str) -> bool:
    """Act as a signal to the own process; return False to send the real signal."""
    handler = runtime.programs.present.signal_handlers.get(number)
    if number in _DEADLY or handler == signal.SIG_DFL:
        _end_process(runtime, f"{call} with {signal.Signals(number).name} for itself", 128 + number)
    if handler is None:
        return _signalled_by_default(runtime, number, call)
    if callable(handler):
        handler(number, sys._getframe(2))
    return True


def _signalled_by_default(runtime: Runtime, number: int, call: str) -> bool:
    """Act as Python and rclpy on a signal for which a main has no handler."""
    program = runtime.programs.present
    if program is runtime.programs.host or number not in _ENDING:
        return False
    if number == signal.SIGINT:
        interrupt(runtime, program)
        if getcurrent() is program.stack:
            raise KeyboardInterrupt
    elif number == signal.SIGTERM and program.shuts_down_on("SIGTERM"):
        shut_down(runtime, program)
    else:
        _end_process(runtime, f"{call} with {signal.Signals(number).name} for itself", 128 + number)
    return True


def _execv(path: Any, argv: Any, /) -> None:
    _refuse("os.execv")
    _real["execv"](path, argv)


def _execve(path: Any, argv: Any, env: Any) -> None:
    _refuse("os.execve")
    _real["execve"](path, argv, env)


def _refuse(call: str) -> None:
    if _calling_node_runtime() is not None:
        raise UnsupportedError(
            f"{call} would replace this process, in which all nodes of the run are: end the node "
            "instead (sys.exit), or start the program with subprocess"
        )


def _calling_node_runtime() -> Runtime | None:
    """Return the runtime of the calling node, None if no node calls."""
    runtime = calling_runtime()
    return runtime if runtime is not None and runtime.event.handle is not None else None


def _end_process(runtime: Runtime, call: str, status: int) -> NoReturn:
    """End the simulated process of the calling code, or the run."""
    handle = runtime.event.handle
    assert handle is not None
    if runtime.ending.unwinding or runtime.ending.closing or getcurrent() is runtime.runners.main:
        raise RunEnded  # it is ending anyway, and this stack is needed
    program = runtime.programs.present
    if program is runtime.programs.host:
        runtime.dispatcher.note(OutputKind.SHUTDOWN, 0, 1, status)
        runtime.loop.stop(Stop(f"{handle.describe()} called {call}", status))
    else:
        runtime.domain.outcome.notes.append(f"{handle.describe()} called {call}")
        for blocked in [one for one in runtime.runners.blocked if one.program is program]:
            del runtime.runners.blocked[blocked]
            abandon(blocked.stack)
            blocked.stop_waiting()
        for thread in [one for one in runtime.threads.alive if one.program is program]:
            thread.end()
        end_program(runtime, program, SystemExit(status))
    runtime.event.on_end = None
    runtime.dispatcher.end_event()
    runtime.programs.leave()
    leave_asyncio()
    abandon(getcurrent())
    runtime.runners.next().switch()
    raise AssertionError("an abandoned stack was resumed")


# A process that a node forks ends with the callback that forked it: only the parent runs the
# simulation and writes the trace. Natively it would go on as a second copy of every node.


def _in_child() -> None:
    for runtime in runtimes:
        if runtime.event.handle is not None and runtime.runners.thread == get_ident():
            runtime.dispatcher.record(None)
            runtime.event.on_end = lambda runtime=runtime: _end(runtime)


def _end(runtime: Runtime) -> None:
    who = runtime.event.handle.describe() if runtime.event.handle is not None else "a node"
    with suppress(Exception):
        sys.stdout.flush()
        tell(
            f"rsltrace: note: ended a process that {who} forked: only the parent process runs the "
            "simulation"
        )
    os._exit(1)


os.register_at_fork(after_in_child=_in_child)
