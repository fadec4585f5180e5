"""A field in which two messages differ."""

from __future__ import annotations

from dataclasses import dataclass

ULP_TOLD_MAX = 1_000_000
"""Reports tell smaller distances in units in the last place: larger ones are no rounding."""

SAME_ELEMENTS = "the same elements in another order"
"""In the note of an array, or a list, that was put together in another order."""
SAME_WORDS = "the same words in another order"
"""In the note of a text."""


@dataclass(frozen=True, slots=True)
class FieldDifference:
    """One field in which two decoded messages differ.

    ``path`` as in ``pose.pose.position.x`` or ``ranges[17]``; values as printable text. For
    numbers ``absolute`` is |a-b| and ``ulp`` the distance in units in the last place (floats of
    the field's own width); ``note`` calls out NaN, -0.0, infinities, lengths. For arrays and
    binary fields ``elements`` says how many differ of how many, ``first`` lists the first few as
    (index, a, b) (binary: offset of a row of 16 bytes, and the row as hex), ``smallest`` and
    ``largest`` are the least and greatest |a-b|, ``ulp`` is the greatest. Times and durations are
    one field, in seconds. ``within_tolerance`` is set when a tolerance covers the difference.
    """

    path: str
    a: str
    b: str
    absolute: float | None = None
    ulp: int | None = None
    note: str = ""
    elements: tuple[int, int] | None = None
    first: tuple[tuple[int, str, str], ...] = ()
    smallest: float | None = None
    largest: float | None = None
    within_tolerance: bool = False
