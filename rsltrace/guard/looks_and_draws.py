"""What nodes were told by clocks and by chance, as far as counts and next answers need it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

LOOK_NS = 1_000
"""What looking at a clock again takes: ``time.time()`` of this century cannot show much less."""
AHEAD_NS_MAX = 1_000_000


class Draw:
    """What draws for a node that calls one function, and how often user code did."""

    __slots__ = ("count", "function")

    def __init__(self, function: Callable[..., Any]) -> None:
        self.count = 0
        self.function = function


class Shown:
    """How far what the clocks of a node showed last was ahead of simulated time, which was
    ``now_ns``."""

    __slots__ = ("ahead_ns", "now_ns")

    def __init__(self) -> None:
        self.now_ns, self.ahead_ns = -1 << 63, 0

    def see(self, now_ns: int) -> None:
        """Take note of the time, which may have been there before, or jumped backwards."""
        ahead_ns = self.now_ns + self.ahead_ns - now_ns
        if ahead_ns < 0 or now_ns < self.now_ns:
            ahead_ns = 0
        elif ahead_ns < AHEAD_NS_MAX:
            ahead_ns += LOOK_NS
        self.now_ns, self.ahead_ns = now_ns, ahead_ns


class Clock:
    """One clock function of a node: how often user code looked, and what all of its clocks show."""

    __slots__ = ("looks", "shown")

    def __init__(self, shown: Shown) -> None:
        self.looks = 0
        self.shown = shown
