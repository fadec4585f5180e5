"""What rclpy waits with, on simulated time: events, and futures that set one."""

from __future__ import annotations

from typing import Any

from rsltrace.adapters.rclpy.stacks.blocking_calls import wait
from rsltrace.adapters.rclpy.stacks.runners import Stacks, Wait
from rsltrace.trace.model.texts import patience_ns


class SimEvent:
    """Stands in for ``threading.Event`` where rclpy waits for what a callback will set."""

    def __init__(self, stacks: Stacks, what: str = "an event to be set") -> None:
        self._stacks = stacks
        self._what = what
        self._set = False
        self._waits: list[Wait] = []

    def is_set(self) -> bool:
        """Return whether the event is set."""
        return self._set

    def set(self) -> None:
        """Set the event and wake everybody who waits for it."""
        self._set = True
        waits, self._waits = self._waits, []
        for blocked in waits:
            blocked.wake()

    def clear(self) -> None:
        """Reset the event."""
        self._set = False

    def wait(self, timeout: float | None = None) -> bool:
        """Wait in simulated time until the event is set; return whether it is."""
        return self.wait_ns(None if timeout is None else patience_ns(timeout))

    def wait_ns(self, timeout_ns: int | None) -> bool:
        """Do ``wait`` with a timeout in nanoseconds."""
        if not self._set:
            wait(self._stacks, self._what, until=self._waits.append, for_ns=timeout_ns)
            self._waits = [blocked for blocked in self._waits if blocked.waiting]
        return self._set


class FutureWake:
    """The done callback of a future that sets an event at once, without becoming a task."""

    def __init__(self, event: SimEvent) -> None:
        self._event = event

    def __call__(self, future: Any) -> None:
        self._event.set()
