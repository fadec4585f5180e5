"""Recorded processes: their ids, output and end. A re-run starts none.

``subprocess`` is Python code above a few functions. With those recorded, all of it (and
``os.popen`` and asyncio's subprocesses) works in a re-run without the program.
"""

from __future__ import annotations

import _multiprocessing  # type: ignore[import-not-found]
import _posixsubprocess
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import FrameType
from typing import Any

from rsltrace.guard.frames import replace_member
from rsltrace.guard.guard import engaged
from rsltrace.guard.recorded.descriptors import recording_guard, unconnected_descriptor
from rsltrace.guard.redirect import redirect, replace_attribute
from rsltrace.guard.waiting import (
    NOT_YET,
    initial_wait_s,
    poll_until,
    wait_recorded,
    wait_unrecorded,
    waiting_guard,
)
from rsltrace.trace.model.finding import NondeterminismSource

_KEPT_OPEN = 3
_LOOKED = "_rsltrace_looked"
_CHILDS_ENDS = (6, 9, 11, 13)
"""Arguments of ``fork_exec``: descriptors that stay open in the child, its standard streams, and
the pipe that reports a failed start."""


def _starting(real: Callable[..., int]) -> Any:
    def fork_exec(*arguments: Any) -> int:
        frame = sys._getframe(1)
        # multiprocessing shares memory and locks with its processes, which cannot be recorded
        by_subprocess = frame.f_globals.get("__name__") == "subprocess"
        guard = recording_guard(NondeterminismSource.PROCESS, frame) if by_subprocess else None
        if guard is None:
            return real(*arguments)
        words = [os.fsdecode(word) for word in arguments[0]]
        call = f"subprocess.Popen({' '.join(words)[:100]!r})"
        descriptors = guard.descriptors
        for fd in (*(arguments[place] for place in _CHILDS_ENDS), *arguments[_KEPT_OPEN]):
            far = descriptors.far_end(fd)
            if far is not None:
                descriptors.add(far, NondeterminismSource.PROCESS)
        process: int = guard.record(
            NondeterminismSource.PROCESS, call, lambda: real(*arguments), frame
        )
        descriptors.processes.add(process)
        return process

    return fork_exec


def _waiting(real: Callable[[int, int], Any]) -> Any:
    def waitpid(process: int, options: int, /) -> Any:
        guard = engaged()
        frame, call = sys._getframe(1), "os.waitpid()"

        def ended() -> Any:
            found = real(process, options | os.WNOHANG)
            return found if found[0] else NOT_YET

        if guard is None or process not in guard.descriptors.processes:
            patient = None if options & os.WNOHANG else waiting_guard(frame)
            if patient is not None:
                return wait_unrecorded(patient, poll_until(ended), frame)
            return real(process, options)
        if options & os.WNOHANG:

            def now_or_soon() -> Any:
                found = poll_until(ended)(_first_wait_s(frame))
                return (0, 0) if found is NOT_YET else found

            return guard.record(NondeterminismSource.PROCESS, call, now_or_soon, frame, process)
        if not guard.context.is_aside():
            return guard.record(
                NondeterminismSource.PROCESS, call, lambda: real(process, options), frame, process
            )
        return wait_recorded(
            guard, NondeterminismSource.PROCESS, call, poll_until(ended), frame, number=process
        )

    return waitpid


def _first_wait_s(frame: FrameType) -> float:
    """Return how many real seconds ``subprocess`` waits at its first look for a program's end."""
    waiting = frame.f_back
    first_s = initial_wait_s(frame, None)
    if not first_s or waiting is None or vars(waiting.f_locals["self"]).get(_LOOKED):
        return 0.0
    setattr(waiting.f_locals["self"], _LOOKED, True)
    return min(first_s, float(waiting.f_locals["timeout"]))


def _of_process(name: str, real: Callable[..., Any]) -> Any:
    """Return the replacement of a function that takes the id of a started process."""

    def function(process: int, *arguments: Any) -> Any:
        guard = engaged()
        if guard is None or process not in guard.descriptors.processes:
            return real(process, *arguments)
        frame = sys._getframe(1)
        opened: list[int] = []

        def call() -> Any:
            value = real(process, *arguments)
            if name == "pidfd_open":
                opened.append(value)
                return None
            return value

        value = guard.record(NondeterminismSource.PROCESS, f"os.{name}()", call, frame, process)
        if name != "pidfd_open":
            return value
        fd = opened[0] if opened else unconnected_descriptor()
        guard.descriptors.drop(fd)
        guard.descriptors.add(fd, NondeterminismSource.PROCESS)
        return fd

    return function


def _running(real: Callable[..., int]) -> Any:
    def system(command: Any) -> Any:
        frame = sys._getframe(1)
        guard = recording_guard(NondeterminismSource.PROCESS, frame)
        if guard is None:
            return real(command)
        call = f"os.system({os.fsdecode(command)[:100]!r})"
        return guard.record(NondeterminismSource.PROCESS, call, lambda: real(command), frame)

    return system


def sleep_for_process(seconds: float, real: Callable[[float], None], frame: FrameType) -> None:
    """Let ``subprocess`` sleep in real time until it looks again for a program's end."""
    guard = recording_guard(NondeterminismSource.PROCESS, frame)
    if guard is None:
        real(seconds)
    elif guard.context.is_aside():
        call = "time.sleep() of subprocess"
        # The rest of a timeout may be less than its clock can show, but time must go on.
        timeout_s = max(seconds, 1e-6)
        wait_recorded(
            guard,
            NondeterminismSource.PROCESS,
            call,
            _no_answer,
            frame,
            number=0,
            timeout_s=timeout_s,
        )
    elif not guard.answers.replays:
        real(seconds)


def _no_answer(seconds: float) -> Any:
    return poll_until(lambda: NOT_YET)(seconds)


def _acquiring(real: Callable[..., bool]) -> Any:
    def acquire(self: Any, block: bool = True, timeout: float | None = None) -> bool:
        """Take a lock of multiprocessing; a process may release it only after others went on."""
        guard = engaged()
        if guard is None or not block or not guard.context.can_step():
            return real(self, block, timeout)
        look = poll_until(lambda: real(self, False) or NOT_YET)
        return wait_unrecorded(guard, look, sys._getframe(1), timeout) is True

    return acquire


@contextmanager
def recorded_processes() -> Iterator[None]:
    """Record processes; in a re-run, return their answers from the trace."""
    with ExitStack() as stack:
        redirect(stack, _posixsubprocess.fork_exec, _starting)
        redirect(stack, os.system, _running)
        redirect(stack, os.waitpid, _waiting)
        for name in ("kill", "pidfd_open"):
            if hasattr(os, name):
                redirect(stack, getattr(os, name), partial(_of_process, name))
        acquire: Any = _multiprocessing.SemLock.acquire
        replace_member(stack, _multiprocessing.SemLock, "acquire", _acquiring)
        replace_member(
            stack, _multiprocessing.SemLock, "__enter__", lambda real: _acquiring(acquire)
        )
        # posix_spawn is not recorded.
        replace_attribute(stack, subprocess, "_USE_POSIX_SPAWN", False)
        yield
