"""asyncio loops on simulated time: a loop with nothing to do is set aside like any blocked call."""

from __future__ import annotations

import asyncio
import asyncio.selector_events
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rsltrace.ros.blocking import POLL_NS, Wait, simulated_core, wait

if TYPE_CHECKING:
    from rsltrace.ros.core import Core

_NS_PER_S = 1_000_000_000

_FREE_ROUNDS = 100
_ROUNDS_PER_POLL = 10
"""A loop that always has something to do polls, most often an rclpy future: asyncio asks again at
once whatever is not its own. After the first rounds, so many of them take ``POLL_NS``."""


class SimSelector:
    """Wraps the selector of an asyncio loop: where it would wait, simulated time passes.

    Descriptors are looked at whenever the loop runs, and never waited for.
    """

    def __init__(self, core: Core, real: Any) -> None:
        self._core = core
        self._real = real
        self._blocked: Wait | None = None
        self._rounds = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    def select(self, timeout: float | None = None) -> Any:
        """Return what is ready, after having waited for the loop's next timer or a wake-up."""
        found = self._real.select(0)
        polls = timeout is not None and timeout <= 0
        self._rounds = self._rounds + 1 if polls else 0
        if found or (polls and not self._costs_time()):
            return found
        core = simulated_core()
        if core is not self._core:
            return self._real.select(timeout)
        # Rounded up, or the loop would look too early, and again without any time having passed.
        for_ns = None if timeout is None else int(timeout * _NS_PER_S) + 1
        if polls:
            for_ns = POLL_NS
        stack_is_thread = core.is_thread
        wait(
            core,
            "something to do in its asyncio loop",
            until=self._keep,
            for_ns=for_ns,
            quiet=True,
            patient=lambda: self._blocked is not None and stack_is_thread(self._blocked.stack),
        )
        self._blocked = None
        return self._real.select(0)

    def _costs_time(self) -> bool:
        rounds = self._rounds
        return rounds > _FREE_ROUNDS and rounds % _ROUNDS_PER_POLL == 0

    def _keep(self, blocked: Wait) -> None:
        self._blocked = blocked

    def wake(self) -> None:
        """Let the loop look again."""
        if self._blocked is not None:
            self._blocked.release()


@contextmanager
def simulated_event_loops(core: Core) -> Iterator[None]:
    """Have asyncio loops that are made within the ``with`` block keep simulated time."""
    base: Any = asyncio.BaseEventLoop
    selecting: Any = asyncio.selector_events.BaseSelectorEventLoop
    real_time, real_init = base.time, selecting.__init__
    real_write = selecting._write_to_self

    def time(self: Any) -> float:
        if isinstance(getattr(self, "_selector", None), SimSelector) and simulated_core():
            return core.loop.now_ns / _NS_PER_S
        return float(real_time(self))

    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:  # noqa: N807
        real_init(self, *args, **kwargs)
        if simulated_core() is core:
            self._selector = SimSelector(core, self._selector)

    def _write_to_self(self: Any) -> None:
        real_write(self)
        if isinstance(self._selector, SimSelector):
            self._selector.wake()

    base.time, selecting.__init__ = time, __init__
    selecting._write_to_self = _write_to_self
    try:
        yield
    finally:
        base.time, selecting.__init__ = real_time, real_init
        selecting._write_to_self = real_write


__all__ = ["SimSelector", "simulated_event_loops"]
