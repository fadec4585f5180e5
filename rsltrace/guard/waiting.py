"""Waiting for something outside of the run, while other threads and event loops go on.

Simulated time passes as fast as real time, in steps of a millisecond. The trace keeps the number of
steps, and a re-run takes as many without waiting. A program that answers or ends soon takes no
simulated time: its duration differs in each run.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

from rsltrace.guard.context import STEP_NS, SimulationContext
from rsltrace.guard.frames import code_of
from rsltrace.guard.guard import Guard, engage, engaged
from rsltrace.guard.libraries import present_import
from rsltrace.guard.recorded_answers import decoded, encoded_answer, finding_value
from rsltrace.guard.redirect import copy_of
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource
from rsltrace.trace.model.texts import waiting_ns

NOT_YET: Any = object()
"""The result of an attempt that found no answer."""

Attempt = Callable[[float], Any]
"""Waits in real time, at most the given seconds; returns the answer or ``NOT_YET``."""

_PROGRAM_S = 5.0
"""How many real seconds simulated time stands still for a started program."""
_OF_A_PROGRAM = ("communicate", "_communicate", "_try_wait")
"""The functions of ``subprocess`` that wait for a program's output and end."""

_poll = copy_of(select.poll)
_sleep = copy_of(time.sleep)
_monotonic = copy_of(time.monotonic)


def wait_recorded(
    guard: Guard,
    source: NondeterminismSource,
    call: str,
    look: Attempt,
    frame: FrameType,
    *,
    number: int,
    timeout_s: float | None = None,
    step: Callable[[int], object] | None = None,
) -> Any:
    """Return the answer to a call that waits for it, or None after the timeout.

    ``step`` lets simulated time pass; if it returns True, the wait ends.

    :raises OSError: if that is the answer.
    """
    context = guard.context
    step = step or context.step
    deadline_ns = _deadline_ns(context, timeout_s)
    steps, first_s = 0, initial_wait_s(frame, timeout_s)
    kept = (
        guard.answers.next_answer(context.node(), call, number) if guard.answers.replays else None
    )
    text: str | None = None
    try:
        while True:
            if kept is None:
                with engage(None):
                    seconds = guard.pace.ahead_s(context.now_ns()) if steps else first_s
                    text = _attempt_text(look, seconds)
                if text is not None:
                    break
            elif steps >= kept.steps and kept.text is not None:
                text = kept.text
                break
            left_ns = STEP_NS
            if deadline_ns is not None:
                left_ns = min(left_ns, deadline_ns - context.now_ns())
            if left_ns <= 0 and kept is None:
                text = "null"
                break
            is_ended = step(max(left_ns, 1))
            steps += 1
            if is_ended and kept is None:
                text = "null"
                break
    finally:
        # None: the run ends before the answer comes, and a re-run waits as long for it.
        guard.report(source, GuardMode.RECORD, call, finding_value(number, steps, text), frame)
    return decoded(text)


def wait_unrecorded(
    guard: Guard,
    look: Attempt,
    frame: FrameType,
    timeout_s: float | None = None,
    step: Callable[[int], object] | None = None,
) -> Any:
    """Wait in the same way for an answer that is not recorded; None after the timeout.

    A thread that blocked for real would stop all others, even those that it waits for.
    """
    context, steps = guard.context, 0
    step = step or context.step
    first_s = initial_wait_s(frame, timeout_s)
    deadline_ns = _deadline_ns(context, timeout_s)
    while True:
        with engage(None):
            found = look(guard.pace.ahead_s(context.now_ns()) if steps else first_s)
        if found is not NOT_YET:
            # Code that always finds an answer may wait for what another thread should fetch.
            if steps == 0 and not first_s and guard.pace.is_greedy():
                context.step(STEP_NS)
            return found
        left_ns = STEP_NS
        if deadline_ns is not None:
            left_ns = min(left_ns, deadline_ns - context.now_ns())
            if left_ns <= 0:
                return None
        guard.pace.in_a_row = 0
        if step(left_ns):
            return None
        steps += 1


def _deadline_ns(context: SimulationContext, timeout_s: float | None) -> int | None:
    return None if timeout_s is None else context.now_ns() + max(waiting_ns(timeout_s), 0)


def initial_wait_s(frame: FrameType, timeout_s: float | None) -> float:
    """Return how many real seconds simulated time stands still for the waiting code.

    Not 0 for programs of ``subprocess`` without an open stdin: those with one may wait for the run.
    Until a program has started, that does not matter.
    """
    while frame.f_back is not None and _is_ours(frame):  # a file or a terminal that calls os.read
        frame = frame.f_back
    if frame.f_globals.get("__name__") != "subprocess":
        return 0.0
    name = code_of(frame).co_name
    if name != "_execute_child":
        stdin = getattr(frame.f_locals.get("self"), "stdin", None)
        if name not in _OF_A_PROGRAM or (stdin is not None and not stdin.closed):
            return 0.0
    return _PROGRAM_S if timeout_s is None else min(timeout_s, _PROGRAM_S)


def _is_ours(frame: FrameType) -> bool:
    return str(frame.f_globals.get("__name__")).startswith("rsltrace.")


def waiting_guard(frame: FrameType) -> Guard | None:
    """Return the guard if the code at ``frame`` should wait like that, or None.

    Threads do, and multiprocessing everywhere: it has threads of its own that must go on.
    """
    guard = engaged()
    if guard is None or present_import() is not None or not guard.context.can_step():
        return None
    module = str(frame.f_globals.get("__name__", ""))
    if guard.context.is_aside() or module.startswith(("multiprocessing.", "torch.multiprocessing")):
        return guard
    return None


def _attempt_text(look: Attempt, seconds: float) -> str | None:
    found: list[Any] = []

    def real() -> Any:
        found.append(look(seconds))
        return None if found[0] is NOT_YET else found[0]

    text = encoded_answer(real)
    return None if found and found[0] is NOT_YET else text


def wait_readable(fd: int, real: Callable[[], Any]) -> Attempt:
    """Return an attempt that calls ``real`` as soon as there is something to read."""

    def look(seconds: float) -> Any:
        waiting = _poll()
        waiting.register(fd, select.POLLIN | select.POLLPRI)
        return real() if waiting.poll(seconds * 1000) else NOT_YET

    return look


def poll_until(real: Callable[[], Any]) -> Attempt:
    """Return an attempt for what cannot be waited for: ``real`` returns it, or ``NOT_YET``."""

    def look(seconds: float) -> Any:
        until_s = _monotonic() + seconds
        while True:
            found = real()
            left_s = until_s - _monotonic()
            if found is not NOT_YET or left_s <= 0:
                return found
            _sleep(min(left_s, STEP_NS / 1e9))

    return look
