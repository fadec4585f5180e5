"""Drive a run from outside: say how far the loop may go, and stop it between two steps.

The loop asks its gate between time steps. The gate switches to the driver's stack when the driver
wants control. The run must not notice: it is the same, event by event, as one recorded at once.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from enum import Enum
from typing import TYPE_CHECKING, Any

from greenlet import getcurrent

from rsltrace.errors import RunError
from rsltrace.run.session import RunSession
from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.loop.stop import quiet_until_ns

if TYPE_CHECKING:
    from rsltrace.adapters.driver import Outside

_INTERRUPTED = 130


class _ActiveCode(Enum):
    """Whose code is running."""

    DRIVER = "driver"
    RUN = "run"
    LISTENER = "listener"


def next_step_ns(loop: EventLoop, next_ns: int | None) -> int | None:
    """Return the time of the loop's next step; ``next_ns`` is what its gate was given."""
    if next_ns is not None and loop.min_step_ns and next_ns > loop.now_ns:
        return loop.stepped(next_ns, quiet_until_ns(loop.stop_conditions))
    return next_ns


class Driver:
    """The loop of an open session, under control.

    ``outside`` is where the driver stands while the loop does not run.
    """

    def __init__(self, session: RunSession) -> None:
        from rsltrace.adapters.driver import Outside

        self.session = session
        self.loop = session.loop
        self.loop.gate = self._gate
        self.outside: Outside = Outside(session.world)
        self._who = _ActiveCode.DRIVER
        self._steps: int | None = 0
        self._until_ns: int | None = None
        self._to_the_end = False
        self._held: tuple[int, tuple[int, int, int]] | None = None
        self._counted = 0
        self._news: list[tuple[Callable[[Any], object], Any]] = []
        self._raised = False

    def begin(self) -> None:
        """Construct the nodes and jump to the start.

        :raises RunError: that failed.
        """
        self.session.begin()
        self.outside.enter()
        self.raise_error()

    @property
    def ended(self) -> bool:
        return self.session.ended

    def position(self) -> tuple[int, int]:
        """Return (events, time). If it has not changed, nothing is left to happen."""
        return self.loop.events, self.loop.now_ns

    def go(
        self,
        *,
        steps: int | None = None,
        until_ns: int | None = None,
        to_the_end: bool = False,
    ) -> None:
        """Let the loop run ``steps`` time steps (None: any number), none after ``until_ns``.

        With ``until_ns``, time then stands there. Unless ``to_the_end``, the loop also stops when
        nothing is left to happen.

        :raises RunError: the run failed.
        """
        self.check_driver()
        if self.ended:
            return
        self.leave()
        self._counted = self.loop.events
        self._steps, self._until_ns, self._to_the_end = steps, until_ns, to_the_end
        while True:
            self._who = _ActiveCode.RUN
            try:
                self.session.go_on()
            finally:
                self._who = _ActiveCode.DRIVER
            self.outside.enter()
            self.raise_error()
            if not self._tell():
                return
            self.leave()

    def leave(self) -> None:
        """Return control to the run.

        If time stood between two steps and nothing was done there, the clock is set back to the
        last step.
        """
        self.outside.leave()
        if self._held is not None:
            last_ns, before = self._held
            if self._activity() == before:
                self.loop.now_ns = last_ns
            self._held = None

    def _activity(self) -> tuple[int, int, int]:
        """Return values that change when the driver does something."""
        loop = self.loop
        return loop.events, len(loop.ready), len(loop.tasks)

    def _gate(self, next_ns: int | None) -> bool:
        if not self._news:
            if self._to_the_end:
                return False
            if self._steps and self.loop.events != self._counted:
                self._steps -= 1  # what was ready when the driver let go
            self._counted = self.loop.events
            if self._steps != 0 and self._may_advance(next_ns):
                return False
        runners = self.session.world.runtime.runners
        runners.waiting.append(getcurrent())
        assert runners.main is not None
        runners.main.switch()
        return True

    def _may_advance(self, next_ns: int | None) -> bool:
        until_ns, end_ns = self._until_ns, self.session.end_ns
        next_ns = next_step_ns(self.loop, next_ns)
        if next_ns is not None and (until_ns is None or next_ns <= until_ns):
            return True
        if until_ns is None:
            return False  # nothing is left to happen, unless the driver does something
        if end_ns is not None and until_ns >= end_ns:
            return True  # the job ends before that: its stop condition will say so
        self._held = (self.loop.now_ns, self._activity())
        self.loop.now_ns = until_ns
        return False

    def call_listener_later(self, callback: Callable[[Any], object], message: Any) -> None:
        self._news.append((callback, message))

    def _tell(self) -> bool:
        """Call the listeners; return whether the loop has to continue."""
        news, self._news = self._news, []
        self._who = _ActiveCode.LISTENER
        try:
            for callback, message in news:
                callback(message)
        finally:
            self._who = _ActiveCode.DRIVER
        return bool(news) and not self.ended

    def check_driver(self) -> None:
        """Raise RunError unless the calling code may move time."""
        self.check_outside()
        if self._who is _ActiveCode.LISTENER:
            raise RunError("a callback of subscribe cannot move time; it may publish")

    def check_outside(self) -> None:
        """Raise RunError if a node, or another thread, calls."""
        if threading.get_ident() != self.session.world.runtime.runners.thread:
            raise RunError("a simulation is driven by the thread that has entered it")
        if self._who is _ActiveCode.RUN:
            raise RunError("a node cannot drive the simulation that it is part of")

    def raise_error(self) -> None:
        """Raise what went wrong in the run, once.

        :raises KeyboardInterrupt: if the run was interrupted.
        """
        if self._raised:
            return
        error, stopped = self.session.error, self.loop.stopped
        if error is not None:
            self._raised = True
            raise error
        if stopped is not None and stopped.exit_code == _INTERRUPTED:
            self._raised = True
            raise KeyboardInterrupt
