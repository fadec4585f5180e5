"""What part of a run the lanes show, in columns whose length is 1, 2 or 5 times a power of ten."""

from __future__ import annotations

from dataclasses import dataclass

_DIGITS = (1, 2, 5)


@dataclass(frozen=True, slots=True)
class Window:
    """What the lanes show. ``order``: places of events; otherwise ns. ``end`` is not included."""

    start: int
    end: int
    order: bool = False

    @property
    def length(self) -> int:
        """In ns, or in events."""
        return self.end - self.start

    def column(self, position: int, columns: int) -> int:
        """Return the column of a time (or place); may lie outside of 0 … columns - 1."""
        return (position - self.start) * columns // max(self.length, 1)

    def at(self, column: int, columns: int) -> int:
        """Return the time (or place) at the left edge of a column."""
        # Rounded up, so that column(at(c)) is c.
        return self.start - (-column * self.length // max(columns, 1))

    def fitted(self, columns: int) -> Window:
        """Return the smallest window around this one whose columns are a step long each, and
        begin at whole steps: then what comes ten times a second looks like it everywhere."""
        columns = max(columns, 1)
        if self.order:
            return self
        step = step_from(-(-self.length // columns))
        while self.start // step * step + columns * step < self.end:
            step = step_from(step + 1)
        start = self.start // step * step
        return Window(start, start + columns * step)

    def step(self, columns: int) -> int:
        """Return how long a column is, in ns."""
        return max(self.length // max(columns, 1), 1)


def step_from(least: int) -> int:
    """Return the shortest step that is at least so long: 1, 2, 5, 10, 20, 50, …"""
    power = 1
    while True:
        for digit in _DIGITS:
            if digit * power >= least:
                return digit * power
        power *= 10


def step_below(step: int) -> int:
    """Return the next shorter step; 1 is the shortest."""
    power = 1
    while power * 10 < step:
        power *= 10
    return max((digit * power for digit in _DIGITS if digit * power < step), default=1)
