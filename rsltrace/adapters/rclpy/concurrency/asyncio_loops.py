"""asyncio loops on simulated time: a loop with nothing to do waits like any blocked call."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

from rsltrace.adapters.rclpy.concurrency.blocking_calls import POLL_NS, calling_runtime, wait
from rsltrace.adapters.rclpy.concurrency.program import places
from rsltrace.adapters.rclpy.concurrency.runtime import BlockedCall, Runtime
from rsltrace.guard.loading import when_loaded
from rsltrace.guard.recorded.polls import RecordedPoll
from rsltrace.guard.redirect import replace_attribute

_NS_PER_S = 1_000_000_000

_FREE_ROUNDS = 100
_ROUNDS_PER_POLL = 10
"""A loop that always has something to do is polling, most often an rclpy future, which asyncio asks
again at once. After the free rounds, every tenth round takes ``POLL_NS``."""


class SimSelector:
    """Wraps the selector of an asyncio loop: where it would wait, simulated time passes.

    File descriptors are polled whenever the loop runs. They are waited for only if they lead
    outside the run and what arrives is recorded.
    """

    def __init__(self, runtime: Runtime, real: Any) -> None:
        self._runtime = runtime
        self._real = real
        self._blocked: BlockedCall | None = None
        self._rounds = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    def select(self, timeout: float | None = None) -> Any:
        """Return what is ready after waiting for the loop's next timer or a wake-up."""
        found = self._real.select(0)
        polls = timeout is not None and timeout <= 0
        self._rounds = self._rounds + 1 if polls else 0
        if found or (polls and not self._costs_time()):
            return found
        runtime = calling_runtime()
        if runtime is not self._runtime:
            return self._real.select(timeout)
        poller = getattr(self._real, "_selector", None)
        if not polls and isinstance(poller, RecordedPoll) and poller.leads_out():
            poller.step = self._step
            try:
                return self._real.select(timeout)
            finally:
                poller.step = None
        # Rounded up, or the loop would look too early, and again without time passing.
        for_ns = None if timeout is None else int(timeout * _NS_PER_S) + 1
        self._step(POLL_NS if polls else for_ns)
        return self._real.select(0)

    def _step(self, for_ns: int | None) -> bool:
        """Wait in simulated time; return whether something woke the loop."""
        stack_is_thread = self._runtime.threads.runs_on
        try:
            return wait(
                self._runtime,
                "something to do in its asyncio loop",
                until=self._keep,
                for_ns=for_ns,
                quiet=True,
                patient=lambda: self._blocked is not None and stack_is_thread(self._blocked.stack),
            )
        finally:
            self._blocked = None

    def _costs_time(self) -> bool:
        rounds = self._rounds
        return rounds > _FREE_ROUNDS and rounds % _ROUNDS_PER_POLL == 0

    def _keep(self, blocked: BlockedCall) -> None:
        self._blocked = blocked

    def wake(self) -> None:
        if self._blocked is not None:
            self._blocked.release()


@contextmanager
def simulated_event_loops(runtime: Runtime) -> Iterator[None]:
    """Give simulated time to asyncio loops that are made within the ``with`` block."""
    with ExitStack() as stack:
        when_loaded(stack, "asyncio", partial(_simulate_loops, stack, runtime))
        yield


def _simulate_loops(stack: ExitStack, runtime: Runtime) -> None:
    import asyncio.selector_events

    runtime.programs.places = places()
    base: Any = asyncio.BaseEventLoop
    selecting: Any = asyncio.selector_events.BaseSelectorEventLoop
    real_time, real_init = base.time, selecting.__init__
    real_write = selecting._write_to_self

    def time(self: Any) -> float:
        if isinstance(getattr(self, "_selector", None), SimSelector) and calling_runtime():
            return runtime.loop.now_ns / _NS_PER_S
        return float(real_time(self))

    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:  # noqa: N807
        real_init(self, *args, **kwargs)
        if calling_runtime() is runtime:
            self._selector = SimSelector(runtime, self._selector)
            # A float of seconds since 1970 cannot represent 100 ns; a timer that is due within
            # less than asyncio's resolution would never run, and time would never go on.
            now_s = runtime.loop.now_ns / _NS_PER_S
            self._clock_resolution = max(self._clock_resolution, 2 * math.ulp(now_s))

    def _write_to_self(self: Any) -> None:
        real_write(self)
        if isinstance(self._selector, SimSelector):
            self._selector.wake()

    replace_attribute(stack, base, "time", time)
    replace_attribute(stack, selecting, "__init__", __init__)
    replace_attribute(stack, selecting, "_write_to_self", _write_to_self)
    # The child watcher numbers its threads: do not count those of another run.
    policy: Any = asyncio.get_event_loop_policy()
    if hasattr(policy, "_watcher"):
        replace_attribute(stack, policy, "_watcher", None)
