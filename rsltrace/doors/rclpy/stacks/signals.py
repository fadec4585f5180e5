"""Signal handlers that nodes set: each main keeps its own, as a process does, and ours stay.

Ctrl-C and SIGTERM end a run properly, whatever one of its nodes would do about them. What a node
sets for other signals (of an alarm, say) works, and is taken back when the run is over.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from greenlet import getcurrent

from rsltrace.doors.rclpy.stacks.simulated_sleep import simulated_stacks
from rsltrace.doors.rclpy.stacks.stacks import Stacks
from rsltrace.guard.redirect import Redirected

_ENDING = frozenset((signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT))


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
            replaced = real_set(number, handler)
            before.setdefault(number, replaced)
            return replaced
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
        return real_get(number)

    def set_wakeup(fd: int, /, **options: Any) -> Any:
        """Asyncio wants a byte of every signal for its loop; those that end a run are not its."""
        return -1 if simulated_stacks() is stacks else real_wakeup(fd, **options)

    with ExitStack() as stack:
        stack.callback(_put_back, before)
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


def _put_back(handlers: dict[int, Any]) -> None:
    if threading.current_thread() is threading.main_thread():
        for number, handler in handlers.items():
            if handler is not None:  # None: it was not set from Python, which cannot set it again
                signal.signal(number, handler)
