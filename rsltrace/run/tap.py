"""Listening to a topic from outside of a simulation, without being part of the graph."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any


class Tap:
    """The messages published on a topic since ``Simulation.subscribe`` was called.

    ``messages`` are (simulated ns, message), oldest first, the last ``depth`` of them; ``count`` is
    how many there were in all. Messages are seen when they are published, before any delay.
    """

    def __init__(
        self, topic: str, callback: Callable[[Any], object] | None, depth: int | None
    ) -> None:
        self.topic = topic
        self.messages: deque[tuple[int, Any]] = deque(maxlen=depth)
        self.count = 0
        self.callback = callback

    @property
    def latest(self) -> Any:
        """The newest message, or None."""
        return self.messages[-1][1] if self.messages else None

    def take(self) -> Any:
        """Remove and return the oldest message, or return None."""
        return self.messages.popleft()[1] if self.messages else None

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the messages, oldest first."""
        return iter([message for _, message in self.messages])

    def __len__(self) -> int:
        return len(self.messages)

    def add(self, stamp_ns: int, message: Any) -> None:
        """Take note of a message."""
        self.count += 1
        self.messages.append((stamp_ns, message))
