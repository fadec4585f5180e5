"""``os._exit``, signals to oneself and the like end the process of a node, which is everybody's.

So for the time of a run they end what they would end natively: one main with its threads, or,
called by a node that the job constructs, the run. As natively, no ``finally`` block and no exit
handler runs: the stacks are left where they are. The trace is whole, and says who did it.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]
import os
import signal
import sys
from asyncio import _get_running_loop, _set_running_loop
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NoReturn

from greenlet import getcurrent

from rsltrace.adapters.rclpy.stacks.blocking_calls import abandon, getpid
from rsltrace.adapters.rclpy.stacks.mains import end_program, interrupt, shut_down
from rsltrace.adapters.rclpy.stacks.runners import RunEnded
from rsltrace.adapters.rclpy.stacks.simulated_sleep import simulated_stacks
from rsltrace.adapters.rclpy.stacks.stacks import Stacks
from rsltrace.errors import UnsupportedError
from rsltrace.guard.process_ids import meant_id
from rsltrace.guard.redirect import Redirected
from rsltrace.simulation.loop.stop import Stop
from rsltrace.trace.model.event import OutputKind

_DEADLY = (signal.SIGKILL, signal.SIGABRT)
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_real: dict[str, Callable[..., Any]] = {}
"""What the functions did before the run, which may be the guard's doing."""


@contextmanager
def own_process_ends(stacks: Stacks) -> Iterator[None]:
    """Let nodes end their process, and not ours, within the ``with`` block."""
    targets: list[tuple[Any, Callable[..., Any]]] = [
        (os._exit, _exit),
        (os.abort, _abort),
        (os.kill, _kill),
        (os.execv, _execv),
        (os.execve, _execve),
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
    stacks = _calling()
    if stacks is None:
        _real["_exit"](status)
    else:
        _leave(stacks, f"os._exit({status})", status & 0xFF)


def _abort() -> None:
    stacks = _calling()
    if stacks is None:
        _real["abort"]()
    else:
        _leave(stacks, "os.abort()", 128 + signal.SIGABRT)


def _kill(pid: int, number: int, /) -> None:
    pid = meant_id(pid)
    stacks = _calling()
    if stacks is None or pid != getpid() or not _signalled(stacks, number, "os.kill"):
        _real["kill"](pid, number)


def _raise_signal(signalnum: int) -> None:
    stacks = _calling()
    if stacks is None or not _signalled(stacks, signalnum, "signal.raise_signal"):
        _real["raise_signal"](signalnum)


def _signalled(stacks: Stacks, number: int, call: str) -> bool:
    """Do what a signal does to the process that sends it to itself; False: nothing of ours."""
    handler = stacks.programs.present.signal_handlers.get(number)
    if number in _DEADLY or handler == signal.SIG_DFL:
        _leave(stacks, f"{call} with {signal.Signals(number).name} for itself", 128 + number)
    if handler is None:
        return _signalled_by_default(stacks, number, call)
    if callable(handler):
        handler(number, sys._getframe(2))
    return True


def _signalled_by_default(stacks: Stacks, number: int, call: str) -> bool:
    """Do what Python and rclpy do about a signal for which a main has set no handler."""
    program = stacks.programs.present
    if program is stacks.programs.host or number not in _ENDING:
        return False
    if number == signal.SIGINT:
        interrupt(stacks, program)
        if getcurrent() is program.stack:
            raise KeyboardInterrupt
    elif number == signal.SIGTERM and any(context.ok() for context in program.contexts):
        shut_down(stacks, program)
    else:
        _leave(stacks, f"{call} with {signal.Signals(number).name} for itself", 128 + number)
    return True


def _execv(path: Any, argv: Any, /) -> None:
    _refuse("os.execv")
    _real["execv"](path, argv)


def _execve(path: Any, argv: Any, env: Any) -> None:
    _refuse("os.execve")
    _real["execve"](path, argv, env)


def _refuse(call: str) -> None:
    if _calling() is not None:
        raise UnsupportedError(
            f"{call} would put another program in the place of this process, in which all nodes of "
            "the run are: end the node instead (sys.exit), or start the program with subprocess"
        )


def _calling() -> Stacks | None:
    """Return the world whose node calls, or None if the process is to do what it is told."""
    stacks = simulated_stacks()
    return stacks if stacks is not None and stacks.event.handle is not None else None


def _leave(stacks: Stacks, call: str, status: int) -> NoReturn:
    """End the process of the calling code: the program, or the run."""
    handle = stacks.event.handle
    assert handle is not None
    if stacks.ending.unwinding or stacks.ending.closing or getcurrent() is stacks.runners.main:
        raise RunEnded  # it is ending anyway, and somebody needs this stack
    program = stacks.programs.present
    if program is stacks.programs.host:
        stacks.dispatcher.note(OutputKind.SHUTDOWN, 0, 1, status)
        stacks.loop.stop(Stop(f"{handle.describe()} called {call}", status))
    else:
        stacks.domain.outcome.notes.append(f"{handle.describe()} called {call}")
        for blocked in [one for one in stacks.runners.blocked if one.program is program]:
            del stacks.runners.blocked[blocked]
            abandon(blocked.stack)
            blocked.stop_waiting()
        for thread in [one for one in stacks.threads.alive if one.program is program]:
            thread.end()
        end_program(stacks, program, SystemExit(status))
    stacks.event.on_end = None
    stacks.dispatcher.end_event()
    stacks.programs.leave()
    if _get_running_loop() is not None:
        _set_running_loop(None)
    abandon(getcurrent())
    stacks.runners.next().switch()
    raise AssertionError("nobody goes back to a stack that was left")
