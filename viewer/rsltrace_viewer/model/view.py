"""What the rows of a timeline stand for: events of one run, or pairs of events of two.

A *place* is a row of the unfiltered timeline. With one trace it is the index of the event.
"""

from __future__ import annotations

from enum import Enum
from typing import Protocol


class Sign(Enum):
    """How a row of two traces compares. The value is what is printed, so no colour is needed."""

    MATCH = "="
    DIFFERS = "≠"
    ONLY_A = "-"
    ONLY_B = "+"
    MOVED = "~"
    """Both runs did the same, at another place in the order or at another time."""
    UNKNOWN = "?"
    """Beyond the part of the runs that was aligned."""


class View(Protocol):
    """Places, numbered from 0."""

    @property
    def count(self) -> int:
        """How many there are."""
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

    def place_of(self, index: int, *, other: bool = False) -> int:
        """Return the place of an event of run a (``other``: of run b)."""
        ...


class SingleView:
    """One trace."""

    def __init__(self, count: int) -> None:
        self.count = count

    def a(self, place: int) -> int | None:
        """Return ``place``."""
        return place

    def b(self, place: int) -> int | None:
        """Return None: there is no other run."""
        return None

    def sign(self, place: int) -> Sign | None:
        """Return None: there is nothing to compare with."""
        return None

    def place_of(self, index: int, *, other: bool = False) -> int:
        """Return ``index``."""
        return index
