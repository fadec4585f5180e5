"""What the rows of a timeline stand for: events of one run, or aligned rows of two.

A *place* is a row of the unfiltered timeline. Of one run it is the index of the event.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt
from rich.cells import cell_len, set_cell_size

from rsltrace.fast_dataclass import dataclass

if TYPE_CHECKING:
    from rsltrace.diff.alignment.aligned_rows import AlignedRows
    from rsltrace.diff.row_sign import RowSign

# Counting events in columns without aliasing: a sensor with a steady rate gets a steady bar.
#
# Whole events, counted in columns of 50 ms, make a sensor of 30 Hz look like 1, 2, 1, 2, 2. So an
# event counts for the time from itself to the next one of its entity, and a column gets as much of
# it as lies in the column. Where events are more than a few columns apart, each is a mark of its
# own.

_APART = 4
"""Events that are more columns apart than this are drawn one by one."""

_USUAL = 0.9
"""The gap between events that is usual: as long as that part of all gaps at most. Not the median:
many entities run twice in a row."""

_SILENT = 2.0
"""A gap that is longer than so many usual ones is silence, and is shown as that."""

Floats = npt.NDArray[np.float64]


def spread(
    starts: Floats, ends: Floats, counts: Floats, step: int, columns: int, *, exact: bool
) -> Floats:
    """Return how many events of one entity fall into each column, in fractions. Shape (columns,).

    ``counts`` events begin at ``starts`` and last until ``ends`` (ns since the left edge, shapes
    (n,), in order and apart). ``exact``: all of an entry's events are at its start.
    """
    single = (ends - starts > _APART * step) & (exact | (counts == 1))
    single |= ends <= starts
    places = np.floor(starts[single] / step).astype(np.int64)
    inside = (places >= 0) & (places < columns)
    found: Floats = np.bincount(
        places[inside], weights=counts[single][inside], minlength=columns
    ).astype(np.float64)
    starts, ends, counts = starts[~single], ends[~single], counts[~single]
    if len(starts):
        # The number of events up to a time: it rises in each entry and stands still in between.
        times = np.stack((starts, ends), axis=1).ravel()
        total = np.cumsum(counts)
        numbers = np.stack((total - counts, total), axis=1).ravel()
        edges = np.arange(columns + 1, dtype=np.float64) * step
        found += np.diff(np.interp(edges, times, numbers))
    return np.asarray(np.round(found, 6))


def ends_of(starts: Floats, counts: Floats) -> Floats:
    """Return when each entry ends: at the next one, but where the entity then was silent for long
    (or for good) after as long as its events usually take."""
    if not len(starts):
        return starts
    gaps = np.diff(starts) / counts[:-1]
    if not len(gaps):
        return starts
    place = int(_USUAL * (len(gaps) - 1))
    usual = float(np.partition(gaps, place)[place])
    silent = np.append(gaps > _SILENT * usual, True)
    return np.where(silent, starts + counts * usual, np.append(starts[1:], 0.0))


# What part of a run the lanes show. Zooming goes in steps of 1, 2 or 5 times a power of ten. A
# whole run gets a step of two digits, so that it fills at least nine tenths of the columns.

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
        step = fine_step_from(-(-self.length // columns))
        while self.start // step * step + columns * step < self.end:
            step = fine_step_from(step + 1)
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


def fine_step_from(least: int) -> int:
    """Return the shortest step of two digits that is at least so long: … 18, 19, 20, 22, … 100."""
    power = 1
    while least > 100 * power:
        power *= 10
    digits = -(-least // power)
    unit = 1 if digits <= 20 else 2 if digits <= 50 else 5
    return -(-digits // unit) * unit * power


def step_below(step: int) -> int:
    """Return the next shorter step; 1 is the shortest."""
    power = 1
    while power * 10 < step:
        power *= 10
    return max((digit * power for digit in _DIGITS if digit * power < step), default=1)


# Text cut and filled to a number of terminal cells, where some characters take two.


def fit(text: str, width: int, *, right: bool = False) -> str:
    """Return ``text`` in exactly ``width`` cells; an ellipsis stands for what is cut off."""
    if width <= 0:
        return ""
    if text.isascii():
        if len(text) <= width:
            return text.rjust(width) if right else text.ljust(width)
        return text[: width - 1] + "…"
    length = cell_len(text)
    if length <= width:
        return " " * (width - length) + text if right else text + " " * (width - length)
    return set_cell_size(text, width - 1) + "…"


def cells(text: str) -> int:
    return len(text) if text.isascii() else cell_len(text)


def wrap(text: str, width: int) -> list[str]:
    """Return ``text`` in lines of at most ``width`` cells, cut at spaces where there are any."""
    lines: list[str] = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split(" "):
            candidate = f"{line} {word}" if line else word
            if cells(candidate) <= width:
                line = candidate
                continue
            if line:
                lines.append(line)
            while cells(word) > width:
                head = set_cell_size(word, width)
                lines.append(head)
                word = word[len(head.rstrip()) or 1 :]
            line = word
        lines.append(line)
    return lines


Ints = npt.NDArray[np.int64]


class View(Protocol):
    """Places, numbered from 0. ``other`` means run b."""

    @property
    def count(self) -> int: ...

    @property
    def version(self) -> int:
        """Changes when events get other places."""
        ...

    def a(self, place: int) -> int | None:
        """Return the index of the event of run a at a place; None if it has none there."""
        ...

    def b(self, place: int) -> int | None:
        """Return the index of the event of run b at a place; None if it has none there."""
        ...

    def sign(self, place: int) -> RowSign | None:
        """Return how the two compare; None with one trace."""
        ...

    def has(self, *, other: bool) -> bool:
        """Return whether events of a run have places."""
        ...

    def before(self, place: int, *, other: bool = False) -> int:
        """Return how many events of a run have places before this one."""
        ...

    def place_of(self, index: int, *, other: bool = False) -> int:
        """Return the place of an event; of a run that is not shown, where it would be."""
        ...

    def places_of(self, indexes: Ints, *, other: bool = False) -> Ints:
        """Return the places of events of a run that is shown."""
        ...


class OneRun:
    """The events of one run in its order: of the only one, or of one of two that are compared."""

    version = 0

    def __init__(
        self, count: int, *, other: bool = False, aligned: AlignedRows | None = None
    ) -> None:
        """Show ``count`` events; with ``aligned``, of run a of two (``other``: of run b)."""
        self.count = count
        self._other = other
        self._aligned = aligned

    def a(self, place: int) -> int | None:
        return None if self._other else place

    def b(self, place: int) -> int | None:
        return place if self._other else None

    def sign(self, place: int) -> RowSign | None:
        """Return how the event compares with that of the other run."""
        if self._aligned is None:
            return None
        return self._aligned.row(self._aligned.place_of(place, of_b=self._other)).sign

    def has(self, *, other: bool) -> bool:
        """Return whether it is this run."""
        return other == self._other

    def before(self, place: int, *, other: bool = False) -> int:
        return place if other == self._other else 0

    def place_of(self, index: int, *, other: bool = False) -> int:
        """Return ``index``; of the other run, where the same event is, or would be."""
        if other == self._other or self._aligned is None:
            return index
        partner = self._aligned.partner(index, of_b=other)
        if partner is not None:
            return partner
        row = self._aligned.place_of(index, of_b=other)
        return min(self._aligned.before(row, of_b=self._other), max(self.count - 1, 0))

    def places_of(self, indexes: Ints, *, other: bool = False) -> Ints:
        return indexes
