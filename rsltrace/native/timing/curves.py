"""How often work can arrive within a time, and how much processor time a supply gives at least.

Times are whole nanoseconds (any unit will do); intervals are half-open, so that what arrives within
a closed interval of length t is ``arrivals(t + 1)``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Arrivals every ``period_ns``, each up to ``jitter_ns`` late, never closer than
    ``distance_ns``."""

    period_ns: int
    jitter_ns: int = 0
    distance_ns: int = 0

    def within(self, length_ns: int) -> int:
        """Return the most arrivals in any interval of that length."""
        if length_ns <= 0:
            return 0
        count = -(-(length_ns + self.jitter_ns) // self.period_ns)
        if self.distance_ns > 0:
            count = min(count, -(-length_ns // self.distance_ns))
        return count

    def delayed(self, by_ns: int) -> Arrivals:
        """Return the arrivals of what comes of these up to ``by_ns`` later, or at once."""
        return Arrivals(self.period_ns, self.jitter_ns + by_ns)

    def earliest(self, end_ns: int) -> Iterator[tuple[int, int]]:
        """Yield (offset, number) of arrivals that all come as early as they can, up to ``end_ns``;
        of those at one offset the last."""
        offset_ns = 0
        while offset_ns < end_ns:
            count = self.within(offset_ns + 1)
            yield offset_ns, count
            after_ns = count * self.period_ns - self.jitter_ns
            offset_ns = max(after_ns, count * self.distance_ns, offset_ns + 1)


@dataclass(frozen=True, slots=True)
class Supply:
    """A reservation: ``budget_ns`` of processor time in each ``period_ns``; equal ones mean a
    processor of its own."""

    budget_ns: int = 1
    period_ns: int = 1

    def time_for(self, work_ns: int) -> int:
        """Return the longest that it may take until so much work is done (Casini et al. 2019,
        section 2: the inverse of the supply-bound function of a periodic reservation)."""
        if work_ns <= 0 or self.budget_ns >= self.period_ns:
            return max(work_ns, 0)
        gap_ns = self.period_ns - self.budget_ns
        rounds, rest_ns = divmod(work_ns, self.budget_ns)
        return gap_ns + rounds * self.period_ns + (gap_ns + rest_ns if rest_ns else 0)


PROCESSOR = Supply()
"""A processor of its own."""
