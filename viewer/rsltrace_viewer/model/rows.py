"""Which events the timeline has as its rows: all of them, or those that fulfil a condition."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace_viewer.model.query.conditions import Condition, mask_of
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.view import View


class Rows(Protocol):
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
    """Every event is a row."""

    def __init__(self, count: int) -> None:
        self.count = count

    def at(self, row: int) -> int:
        """Return ``row``."""
        return row

    def near(self, place: int) -> int:
        """Return ``place``, or the last row."""
        return max(min(place, self.count - 1), 0)


class FilteredRows:
    """The events that fulfil a condition; found segment by segment with ``advance``.

    One bit per event is kept, so a filter of ten million events takes little over a megabyte.
    """

    def __init__(self, run: Run, condition: Condition, view: View) -> None:
        self._run = run
        self._condition = condition
        self._view = view
        self._bits: list[npt.NDArray[np.uint8] | None] = []
        self._ends: list[int] = []

    @property
    def count(self) -> int:
        """How many matching events are known."""
        return self._ends[-1] if self._ends else 0

    @property
    def done(self) -> bool:
        """Whether all segments were looked at."""
        return len(self._bits) == len(self._run.segments)

    @property
    def progress(self) -> float:
        """The part of the run that was looked at, 0 to 1."""
        return len(self._bits) / max(len(self._run.segments), 1)

    def advance(self) -> None:
        """Look at one more segment. One that cannot be read has no rows."""
        number = len(self._bits)
        found = 0
        bits = None
        if self._condition.can_be_in(self._run, number):
            try:
                _, mask = mask_of(self._run, self._condition, number)
                found = int(mask.sum())
                bits = np.packbits(mask) if found else None
            except TraceError:
                pass
        self._ends.append(self.count + found)
        self._bits.append(bits)

    def at(self, row: int) -> int:
        """Return the place of a row."""
        ends = np.asarray(self._ends)
        number = int(np.searchsorted(ends, row, side="right"))
        before = self._ends[number - 1] if number else 0
        return self._view.place_of(int(self._indexes(number)[row - before]))

    def near(self, place: int) -> int:
        """Return the row of a place or of the next one shown."""
        index = self._view.a(place) if self._ends else None
        while index is None and place and self._ends:
            place -= 1
            index = self._view.a(place)
        if index is None:
            return 0
        number = min(self._run.segment_of(index), len(self._bits) - 1)
        before = self._ends[number - 1] if number else 0
        row = before + int(np.searchsorted(self._indexes(number), index))
        return max(min(row, self.count - 1), 0)

    def _indexes(self, number: int) -> npt.NDArray[np.int64]:
        bits = self._bits[number]
        if bits is None:
            return np.zeros(0, dtype=np.int64)
        first = int(self._run.segments[number]["first_event"])
        return np.flatnonzero(np.unpackbits(bits)) + first
