"""Which checkpoints there are, and which of too many is to go."""

from __future__ import annotations

from bisect import bisect_right, insort
from dataclasses import dataclass, field

from rsltrace.debug.processes import SimProcess

_NEAR_EVENTS = 2_000
"""Closer to the cursor than this, all places are equally worth a checkpoint."""

COUNT_MAX = 500
"""Each has a socket to the supervisor, which may have a thousand."""

LADDER = (2048, 128, 8)
"""How many events before a goal checkpoints are left on the way there: who goes back one event
goes back another."""


@dataclass(order=True)
class Checkpoint:
    """A process asleep at an index (and time, in ns); ``bytes`` is its memory (PSS) when last
    looked at."""

    index: int
    stamp_ns: int
    process: SimProcess = field(compare=False)
    bytes: int = field(default=0, compare=False)


class Checkpoints:
    """Checkpoints in the order of their indices, ``count_max`` at most."""

    def __init__(self, count_max: int) -> None:
        self.count_max = count_max
        self._all: list[Checkpoint] = []

    def __len__(self) -> int:
        return len(self._all)

    def all(self) -> list[Checkpoint]:
        """Return them in order."""
        return list(self._all)

    def add(self, checkpoint: Checkpoint) -> bool:
        """Add one, unless one is there already."""
        if any(one.index == checkpoint.index for one in self._all):
            return False
        insort(self._all, checkpoint)
        return True

    def remove(self, checkpoint: Checkpoint) -> None:
        """Forget one."""
        self._all = [one for one in self._all if one is not checkpoint]

    def before(self, index: int) -> list[Checkpoint]:
        """Return those at ``index`` or before it, the nearest first."""
        at = bisect_right([one.index for one in self._all], index)
        return self._all[:at][::-1]

    def before_time(self, stamp_ns: int) -> list[Checkpoint]:
        """Return those that are no later than a time, the latest first."""
        return [one for one in self._all if one.stamp_ns <= stamp_ns][::-1]

    def least_useful(self, cursor: int) -> Checkpoint | None:
        """Return the one whose loss costs least: its neighbours are close to each other, as seen
        from the cursor. So they are log-spaced around it. The first one stays."""
        best, least = None, 0.0
        for place in range(1, len(self._all)):
            one = self._all[place]
            end = (
                self._all[place + 1].index if place + 1 < len(self._all) else max(cursor, one.index)
            )
            gap = end - self._all[place - 1].index
            cost = gap / (abs(one.index - cursor) + _NEAR_EVENTS)
            if best is None or cost < least:
                best, least = one, cost
        return best

    def ladder(self, start: int, goal: int) -> list[int]:
        """Return the indices at which to leave checkpoints on the way from ``start`` to a goal."""
        return [goal - step for step in LADDER if goal - step >= start + step]
