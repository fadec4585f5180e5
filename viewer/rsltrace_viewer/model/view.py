"""What the rows of a timeline stand for: events of one run, or aligned rows of two.

A *place* is a row of the unfiltered timeline. Of one run it is the index of the event.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from rsltrace.diff.alignment.aligned_rows import AlignedRows
    from rsltrace.diff.row_sign import Sign

Ints = npt.NDArray[np.int64]


class View(Protocol):
    """Places, numbered from 0. ``other`` means run b."""

    @property
    def count(self) -> int:
        """How many there are."""
        ...

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

    def sign(self, place: int) -> Sign | None:
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
        """Return ``place``, if this is run a."""
        return None if self._other else place

    def b(self, place: int) -> int | None:
        """Return ``place``, if this is run b."""
        return place if self._other else None

    def sign(self, place: int) -> Sign | None:
        """Return how the event compares with that of the other run."""
        if self._aligned is None:
            return None
        return self._aligned.row(self._aligned.place_of(place, of_b=self._other)).sign

    def has(self, *, other: bool) -> bool:
        """Return whether it is this run."""
        return other == self._other

    def before(self, place: int, *, other: bool = False) -> int:
        """Return ``place``, for this run."""
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
        """Return ``indexes``."""
        return indexes
