"""The end of a run: how far user code has been told of it, and what it is still allowed."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class Ending:
    """``closing``: mains are told to end, and do. ``unwinding``: nothing waits any more, blocked
    calls raise ``RunEnded``. ``stuck`` says who still waited when nothing could happen any more.

    ``grace_ns`` and ``shutdown_ns`` are how long mains and ``destroy_node`` have slept since, while
    time stands still; ``refused`` counts the waits of those who go on regardless.
    """

    closing: bool = False
    unwinding: bool = False
    stuck: list[str] = field(default_factory=list)
    grace_ns: int = 0
    shutdown_ns: int = 0
    refused: int = 0
