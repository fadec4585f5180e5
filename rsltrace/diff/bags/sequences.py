"""Which messages of two sequences belong together, when some may be missing or extra.

Works on keys that are equal for equal messages. What is left unmatched comes out as gaps: ranges
of both sequences between messages that match.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from difflib import SequenceMatcher
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Keys = npt.NDArray[np.uint64]
_SMALL = 250_000
"""Up to this many pairs of keys, equal runs of keys that repeat are looked for, too."""


class Gap(NamedTuple):
    """A range of each sequence without a match; one of them may be empty."""

    a_start: int
    a_end: int
    b_start: int
    b_end: int

    @property
    def surplus(self) -> int:
        """How many more there are in a than in b."""
        return (self.a_end - self.a_start) - (self.b_end - self.b_start)


def gaps_by_order(a: Keys, b: Keys, within: list[Gap] | None = None) -> list[Gap]:
    """Return the gaps between two sequences in their order; no gap if they are equal.

    Keys that occur once in both, in the same order, are anchors (as in a patience diff), so one
    message that is missing does not make those after it different. ``within`` are gaps found with
    finer keys: what is between them is known to be equal, whatever its keys.
    """
    outer = [Gap(0, len(a), 0, len(b))] if within is None else within
    return [inner for gap in outer for inner in _gaps(a, b, gap)]


def gaps_by_stamp(a: Keys, b: Keys, stamps_a: Keys, stamps_b: Keys) -> list[Gap]:
    """Return the gaps when messages belong together that have the same stamp (sorted, both).

    Of several messages with one stamp, the first belongs to the first, and so on.
    """
    gaps = []
    i = j = 0
    keys_a, keys_b = a.tolist(), b.tolist()
    times_a, times_b = stamps_a.tolist(), stamps_b.tolist()
    while i < len(keys_a) or j < len(keys_b):
        if j == len(keys_b) or (i < len(keys_a) and times_a[i] < times_b[j]):
            gaps.append(Gap(i, i + 1, j, j))
            i += 1
        elif i == len(keys_a) or times_b[j] < times_a[i]:
            gaps.append(Gap(i, i, j, j + 1))
            j += 1
        else:
            if keys_a[i] != keys_b[j]:
                gaps.append(Gap(i, i + 1, j, j + 1))
            i += 1
            j += 1
    return gaps


def _gaps(a: Keys, b: Keys, gap: Gap, *, anchored: bool = False) -> Iterator[Gap]:
    gap = _trimmed(a, b, gap)
    a_start, a_end, b_start, b_end = gap
    size_a, size_b = a_end - a_start, b_end - b_start
    if not (size_a and size_b):
        if size_a or size_b:
            yield gap
        return
    if not anchored:
        at_a, at_b = _anchors(a[a_start:a_end], b[b_start:b_end])
        if at_a:
            for x, y in zip(at_a, at_b, strict=True):
                yield from _gaps(
                    a, b, Gap(a_start, gap.a_start + x, b_start, gap.b_start + y), anchored=True
                )
                a_start, b_start = gap.a_start + x + 1, gap.b_start + y + 1
            yield from _gaps(a, b, Gap(a_start, a_end, b_start, b_end), anchored=True)
            return
    if size_a == size_b or size_a * size_b > _SMALL:
        yield gap
        return
    matcher = SequenceMatcher(
        None, a[a_start:a_end].tolist(), b[b_start:b_end].tolist(), autojunk=False
    )
    for tag, x0, x1, y0, y1 in matcher.get_opcodes():
        if tag != "equal":
            yield Gap(a_start + x0, a_start + x1, b_start + y0, b_start + y1)


def _trimmed(a: Keys, b: Keys, gap: Gap) -> Gap:
    """Return the gap without what is equal at its start and at its end."""
    a_start, a_end, b_start, b_end = gap
    size = min(a_end - a_start, b_end - b_start)
    different = np.flatnonzero(a[a_start : a_start + size] != b[b_start : b_start + size])
    head = int(different[0]) if len(different) else size
    a_start, b_start, size = a_start + head, b_start + head, size - head
    different = np.flatnonzero(a[a_end - size : a_end] != b[b_end - size : b_end])
    tail = size - 1 - int(different[-1]) if len(different) else size
    return Gap(a_start, a_end - tail, b_start, b_end - tail)


def _anchors(a: Keys, b: Keys) -> tuple[list[int], list[int]]:
    """Return the places of keys that are unique in both, as long as possible in one order."""
    unique_a, first_a, count_a = np.unique(a, return_index=True, return_counts=True)
    unique_b, first_b, count_b = np.unique(b, return_index=True, return_counts=True)
    single_a, single_b = count_a == 1, count_b == 1
    _, in_a, in_b = np.intersect1d(
        unique_a[single_a], unique_b[single_b], assume_unique=True, return_indices=True
    )
    at_a, at_b = first_a[single_a][in_a], first_b[single_b][in_b]
    order = np.argsort(at_a)
    at_a, at_b = at_a[order], at_b[order]
    if not len(at_b) or bool((np.diff(at_b) > 0).all()):
        return at_a.tolist(), at_b.tolist()
    chosen = _longest_increasing(at_b.tolist())
    return at_a[chosen].tolist(), at_b[chosen].tolist()


def _longest_increasing(values: list[int]) -> list[int]:
    """Return the places of a longest increasing subsequence."""
    ends: list[int] = []
    end_places: list[int] = []
    before: list[int] = []
    for place, value in enumerate(values):
        length = bisect_left(ends, value)
        before.append(end_places[length - 1] if length else -1)
        if length == len(ends):
            ends.append(value)
            end_places.append(place)
        else:
            ends[length] = value
            end_places[length] = place
    chosen = []
    place = end_places[-1]
    while place >= 0:
        chosen.append(place)
        place = before[place]
    return chosen[::-1]
