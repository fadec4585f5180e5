"""Delta debugging (Zeller and Hildebrandt, 2002): which of many things does a failure need?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TypeVar

T = TypeVar("T")


def ddmin(items: Sequence[T], fails: Callable[[list[T]], bool]) -> list[T]:
    """Return some of ``items``, in their order, with which ``fails`` says that it still does, and
    of which none can be left out alone (or none at all, if it fails without any).

    All of them have to fail; they are not asked again. ``fails`` need not be monotonic: what fails
    with few things may pass with more. It is asked about each selection once, at most about
    n^2 + 3n, and about 2 log2(n) if one thing is to blame.
    """
    known: dict[tuple[int, ...], bool] = {tuple(range(len(items))): True}

    def still_fails(chosen: Sequence[int]) -> bool:
        key = tuple(chosen)
        if key not in known:
            known[key] = fails([items[index] for index in key])
        return known[key]

    left = list(range(len(items)))
    if still_fails([]):
        return []
    parts = 2
    while len(left) >= 2:
        pieces = _pieces(left, parts)
        rests = [[one for one in left if one not in piece] for piece in pieces]
        for smaller, next_parts in (
            *((piece, 2) for piece in pieces),
            *((rest, max(parts - 1, 2)) for rest in rests if parts > 2),
        ):
            if still_fails(smaller):
                left, parts = smaller, next_parts
                break
        else:
            if parts >= len(left):
                break
            parts = min(2 * parts, len(left))
    return [items[index] for index in left]


def _pieces(left: Sequence[int], count: int) -> list[list[int]]:
    """Return ``left`` in ``count`` pieces of nearly the same length, none of them empty."""
    ends = [len(left) * number // count for number in range(count + 1)]
    return [list(left[begin:end]) for begin, end in pairwise(ends)]
