"""The longest increasing subsequence: what two orders have in common at most."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence


def longest_increasing(values: Sequence[int]) -> frozenset[int]:
    """Return the places of as many values as can be that rise from one to the next.

    Negative values are left out. Where several choices are equally long, which one it is depends on
    the values alone. Takes n log n steps.
    """
    tails: list[int] = []  # of the best chain of each length: the value it ends with, and where
    ends: list[int] = []
    before: dict[int, int] = {}
    for place, value in enumerate(values):
        if value < 0:
            continue
        length = bisect_left(tails, value)
        if length == len(tails):
            tails.append(value)
            ends.append(place)
        tails[length], ends[length] = value, place
        before[place] = ends[length - 1] if length else -1
    chosen = set()
    place = ends[-1] if ends else -1
    while place >= 0:
        chosen.add(place)
        place = before[place]
    return frozenset(chosen)
