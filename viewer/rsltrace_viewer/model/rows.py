"""Which events the timeline has as its rows: all of them, or those that fulfil a condition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace_viewer.model.query.conditions import EventFilter, mask_of
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.view import View

_BLOCK = 4096
"""Places that are counted together."""


class RowList(Protocol):
    """Rows of a timeline, numbered from 0."""

    @property
    def count(self) -> int:
        """How many there are (so far)."""
        ...

    def at(self, row: int) -> int:
        """Return the place that row ``row`` (must exist) stands for."""
        ...

    def near(self, place: int) -> int:
        """Return the row of ``place``, or of the next one shown; the last if none is."""
        ...


class AllRows:
    def __init__(self, count: int) -> None:
        self.count = count

    def at(self, row: int) -> int:
        return row

    def near(self, place: int) -> int:
        """Return ``place``, or the last row."""
        return max(min(place, self.count - 1), 0)


class FilteredRows:
    """The places with an event that fulfils its run's condition; found segment by segment with
    ``advance``, which may run in a thread of its own.

    One bit per event is kept, and a byte per place: ten megabytes for ten million events.
    """

    def __init__(self, sought: Sequence[tuple[Run, EventFilter, bool]], view: View) -> None:
        """Look in each run for what fulfils its condition. The bool says that it is run b."""
        self._found = [_Found(run, condition, other) for run, condition, other in sought]
        self._view = view
        self._version = -1
        self._shown: npt.NDArray[np.bool_] = np.zeros(0, dtype=np.bool_)
        self._ends = np.zeros(0, dtype=np.int64)

    @property
    def count(self) -> int:
        ends = self._up_to_date()
        return int(ends[-1]) if len(ends) else 0

    @property
    def done(self) -> bool:
        """Whether all segments were looked at."""
        return all(one.done for one in self._found)

    @property
    def progress(self) -> float:
        """The part of the runs that was looked at, 0 to 1."""
        looked = sum(len(one.bits) for one in self._found)
        return looked / max(sum(len(one.run.segments) for one in self._found), 1)

    def advance(self) -> None:
        """Look at one more segment, where least is known. One that cannot be read has no rows."""
        left = [one for one in self._found if not one.done]
        min(left, key=lambda one: len(one.bits)).advance()

    def at(self, row: int) -> int:
        ends = self._up_to_date()
        block = int(np.searchsorted(ends, row, side="right"))
        before = int(ends[block - 1]) if block else 0
        return int(self._places(block)[row - before])

    def near(self, place: int) -> int:
        """Return the row of a place or of the next one shown."""
        ends = self._up_to_date()
        if not len(ends):
            return 0
        block = min(place // _BLOCK, len(ends) - 1)
        before = int(ends[block - 1]) if block else 0
        row = before + int(np.searchsorted(self._places(block), place))
        return max(min(row, int(ends[-1]) - 1), 0)

    def _places(self, block: int) -> npt.NDArray[np.int64]:
        start = block * _BLOCK
        return np.flatnonzero(self._shown[start : start + _BLOCK]) + start

    def _up_to_date(self) -> npt.NDArray[np.int64]:
        """Return how many rows there are up to the end of each block of places."""
        if self._version != self._view.version:  # events have other places
            self._version = self._view.version
            blocks = -(-self._view.count // _BLOCK)
            self._shown = np.zeros(blocks * _BLOCK, dtype=np.bool_)
            for one in self._found:
                one.placed = 0
        new = False
        for one in self._found:
            for number in range(one.placed, len(one.bits)):
                indexes = one.indexes(number)
                self._shown[self._view.places_of(indexes, other=one.other)] = True
                one.placed, new = number + 1, True
        if new:
            self._ends = np.cumsum(self._shown.reshape(-1, _BLOCK).sum(axis=1))
        return self._ends


class _Found:
    """What fulfils a condition in one run, so far: a bit for each event of a segment."""

    def __init__(self, run: Run, condition: EventFilter, other: bool) -> None:
        self.run = run
        self.other = other
        self.bits: list[npt.NDArray[np.uint8] | None] = []
        self.placed = 0
        """How many segments have their places."""
        self._condition = condition

    @property
    def done(self) -> bool:
        return len(self.bits) == len(self.run.segments)

    def advance(self) -> None:
        number = len(self.bits)
        bits = None
        if self._condition.can_be_in(self.run, number):
            try:
                _, mask = mask_of(self.run, self._condition, number)
                bits = np.packbits(mask) if mask.any() else None
            except TraceError:
                pass
        self.bits.append(bits)

    def indexes(self, number: int) -> npt.NDArray[np.int64]:
        bits = self.bits[number]
        if bits is None:
            return np.zeros(0, dtype=np.int64)
        first = int(self.run.segments[number]["first_event"])
        return np.flatnonzero(np.unpackbits(bits)) + first
