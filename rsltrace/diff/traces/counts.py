"""Counts over aligned events, and where the runs agree again."""

from __future__ import annotations

from rsltrace.diff.alignment.blocks import AlignedBlock, EqualBlock, EventPair
from rsltrace.diff.alignment.entity_matching import EntityMatching
from rsltrace.diff.alignment.rows import SHUTDOWN
from rsltrace.diff.result.traces import EntityCount

AGREEING_MIN = 32
"""So many events in a row have to agree before it is called agreement …"""

AGREEING_AT_END_MIN = 8
"""… or so many if they are the last ones of both runs. Shutting down is no agreement."""


class EventCounts:
    """Takes blocks in order."""

    def __init__(self) -> None:
        self._counts: dict[int, list[int]] = {}
        self._resync: tuple[int, int] | None = None
        self._agreeing = 0
        self._ended = False

    def take(self, block: AlignedBlock) -> None:
        """Count the items of a block."""
        for item in block.items:
            rows, index = (block.rows_a, item.a) if item.a >= 0 else (block.rows_b, item.b)
            counts = self._counts.setdefault(rows.number[index - rows.first], [0, 0, 0, 0])
            counts[_column(item)] += 1
            if not item.plain:
                self._agreeing, self._resync = 0, None
            elif rows.kind[index - rows.first] != SHUTDOWN:
                self._agreeing += 1
                self._resync = self._resync or (item.a, item.b)
        self._ended = block.at_end

    def take_equal(self, run: EqualBlock) -> None:
        """Count a run of equal events."""
        for number in run.counts.nonzero()[0].tolist():
            self._counts.setdefault(number, [0, 0, 0, 0])[0] += int(run.counts[number])
        self._agreeing += int(run.counts.sum())
        self._resync = self._resync or (run.first_a, run.first_b)

    def counts(self, matching: EntityMatching) -> tuple[EntityCount, ...]:
        """Return the counts of each entity that had events, those that differ most first."""
        counts = [EntityCount(matching.keys[n], *row) for n, row in self._counts.items()]
        return tuple(
            sorted(counts, key=lambda c: (-(c.differing + c.only_a + c.only_b), str(c.entity)))
        )

    @property
    def resync(self) -> tuple[int, int] | None:
        """The indexes from which on the runs agree to the end of what was aligned, if they do."""
        enough = AGREEING_AT_END_MIN if self._ended else AGREEING_MIN
        return self._resync if self._agreeing >= enough else None


def _column(item: EventPair) -> int:
    if item.b < 0:
        return 2
    if item.a < 0:
        return 3
    return 0 if item.same else 1
