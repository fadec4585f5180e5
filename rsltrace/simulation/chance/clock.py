"""A clock that is wrong: offset, drift, and jumps that are given or drawn."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from rsltrace.simulation.chance.exact import log
from rsltrace.simulation.chance.stream import Stream


@dataclass(frozen=True, slots=True)
class ClockModel:
    """What is wrong with a clock. Times are nanoseconds; those of jumps count from the start.

    ``random_every_ns`` is the mean time between random jumps (0: none), uniform up to
    ``random_most_ns`` in both directions.
    """

    offset_ns: int = 0
    drift: Fraction = Fraction(0)
    jumps: tuple[tuple[int, int], ...] = ()
    random_every_ns: int = 0
    random_most_ns: int = 0


class WrongClock:
    """What one node's clock shows. Exact: no floats take part after the draws."""

    def __init__(self, model: ClockModel, stream: Stream, start_ns: int) -> None:
        self._model = model
        self._start_ns = start_ns
        self._given_at = [at_ns for at_ns, _ in model.jumps]
        self._given_sum = _sums([by_ns for _, by_ns in model.jumps])
        self._uniform = stream.uniform
        self._drawn_at: list[int] = []
        self._drawn_sum = [0]
        self._drawn_until_ns = 0
        self._told = 0

    def shows(self, now_ns: int) -> int:
        """Return what the clock shows at simulated time ``now_ns``."""
        model = self._model
        since_ns = now_ns - self._start_ns
        drift_ns = since_ns * model.drift.numerator // model.drift.denominator
        wrong_ns = model.offset_ns + drift_ns
        wrong_ns += self._given_sum[bisect_right(self._given_at, since_ns)]
        if model.random_every_ns:
            self._draw_until(since_ns)
            wrong_ns += self._drawn_sum[bisect_right(self._drawn_at, since_ns)]
        return max(now_ns + wrong_ns, 0)

    def set_since(self, now_ns: int) -> int:
        """Return by how much random jumps have set the clock since this was last asked."""
        if not self._model.random_every_ns:
            return 0
        since_ns = now_ns - self._start_ns
        self._draw_until(since_ns)
        count = max(bisect_right(self._drawn_at, since_ns), self._told)
        before, self._told = self._told, count
        return self._drawn_sum[count] - self._drawn_sum[before]

    def _draw_until(self, since_ns: int) -> None:
        """Draw the jumps up to a time: gaps are exponential."""
        model = self._model
        while self._drawn_until_ns <= since_ns:
            gap_ns = int(-log(self._uniform()) * model.random_every_ns) + 1
            size_ns = int((2.0 * self._uniform() - 1.0) * model.random_most_ns)
            self._drawn_until_ns += gap_ns
            self._drawn_at.append(self._drawn_until_ns)
            self._drawn_sum.append(self._drawn_sum[-1] + size_ns)


def _sums(values: Sequence[int]) -> list[int]:
    sums = [0]
    for value in values:
        sums.append(sums[-1] + value)
    return sums
