"""Signal handlers that nodes set: each main keeps its own, as a process does, and ours stay.

Ctrl-C, SIGTERM and SIGHUP end a run properly, whatever one of its nodes would do about them. What a
node sets for other signals (of an alarm, say) works, and is taken back when the run is over, as are
the alarms themselves. A handler that raises does so in the code of nodes alone: what interrupts
rsltrace itself ends the run.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any

from greenlet import getcurrent

from rsltrace.adapters.rclpy.stacks.simulated_sleep import simulated_stacks
from rsltrace.adapters.rclpy.stacks.stacks import Stacks
from rsltrace.guard.callers import is_user_file
from rsltrace.guard.redirect import Redirected
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.events.failure import (
    Raised,
    is_own_frame,
    text_of,
    user_traceback,
)

_ENDING = frozenset((signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT))
_TIMERS = (signal.ITIMER_REAL, signal.ITIMER_VIRTUAL, signal.ITIMER_PROF)


class _Handler:
    """A node's signal handler, which may interrupt anything."""

    def __init__(self, domain: Domain, handler: Callable[[int, FrameType | None], Any]) -> None:
        self._domain = domain
        self.handler = handler

    def __call__(self, number: int, frame: FrameType | None) -> None:
        loop, outcome = self._domain.loop, self._domain.outcome
        if loop.stopped is not None:
            return  # an alarm that rings faster than it is heard would never let the run end
        try:
            self.handler(number, frame)
        except BaseException as error:
            if _is_in_user_code(frame):
                raise
            label = f"the handler of {signal.Signals(number).name} that a node has set"
            said = Raised(error, label, "", loop.now_ns, user_traceback(error), text_of(error))
            outcome.error = outcome.error or said.as_error()
            loop.stop(Stop(f"{label} raised {said.kind}", outcome.error.exit_code))


def _is_in_user_code(frame: FrameType | None) -> bool:
    """Say whether an exception there would come out of a node's code, and not out of ours."""
    while frame is not None and not is_own_frame(frame):
        file = frame.f_code.co_filename
        if not file.startswith("<") and is_user_file(file):
            return True
        frame = frame.f_back
    return False


@contextmanager
def own_signal_handlers(stacks: Stacks) -> Iterator[None]:
    """Keep the signal handlers of nodes apart from the process's within the ``with`` block."""
    before: dict[int, Any] = {}

    def set_handler(number: Any, handler: Any, /) -> Any:
        if simulated_stacks() is not stacks:
            return real_set(number, handler)
        if getcurrent() in stacks.threads.by_stack:
            raise ValueError("signal only works in main thread of the main interpreter")
        if number not in _ENDING:
            given = _Handler(stacks.domain, handler) if callable(handler) else handler
            replaced = real_set(number, given)
            before.setdefault(number, replaced)
            return _own(replaced)
        if not callable(handler) and handler not in (signal.SIG_DFL, signal.SIG_IGN):
            raise TypeError(
                "signal handler must be signal.SIG_IGN, signal.SIG_DFL, or a callable object"
            )
        replaced = get_handler(number)
        stacks.programs.present.signal_handlers[int(number)] = handler
        return replaced

    def get_handler(number: Any, /) -> Any:
        if simulated_stacks() is stacks and number in stacks.programs.present.signal_handlers:
            return stacks.programs.present.signal_handlers[int(number)]
        return _own(real_get(number))

    def set_wakeup(fd: int, /, **options: Any) -> Any:
        """Asyncio wants a byte of every signal for its loop; those that end a run are not its."""
        return -1 if simulated_stacks() is stacks else real_wakeup(fd, **options)

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


def _own(handler: Any) -> Any:
    return handler.handler if isinstance(handler, _Handler) else handler


def _end_timers(armed: set[int]) -> None:
    """End the alarms that nodes have set: nobody is left who would handle them."""
    for timer in _TIMERS:
        if timer not in armed and signal.getitimer(timer)[0]:
            signal.setitimer(timer, 0)


def _put_back(handlers: dict[int, Any]) -> None:
    if threading.current_thread() is threading.main_thread():
        for number, handler in handlers.items():
            if handler is not None:  # None: it was not set from Python, which cannot set it again
                signal.signal(number, handler)
