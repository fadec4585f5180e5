"""Which checkpoints stay: log-spaced around the cursor, the first one always."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from rsltrace.debug.checkpoints import LADDER, Checkpoint, Checkpoints


def thinned(indices: list[int], count_max: int, cursor: int) -> list[int]:
    process: Any = None
    checkpoints = Checkpoints(count_max)
    for index in indices:
        checkpoints.add(Checkpoint(index, index, process))
        while len(checkpoints) > count_max:
            worst = checkpoints.least_useful(cursor)
            assert worst is not None
            checkpoints.remove(worst)
    return [one.index for one in checkpoints.all()]


@given(st.lists(st.integers(1, 10**6), max_size=200), st.integers(1, 30), st.integers(0, 10**6))
def test_there_are_as_many_as_there_may_be_and_the_first_stays(
    indices: list[int], count_max: int, cursor: int
) -> None:
    kept = thinned([0, *indices], count_max, cursor)
    assert kept[0] == 0
    assert kept == sorted(set(kept))
    assert len(kept) == min(count_max, len({0, *indices}))


def test_they_are_closer_to_each_other_near_the_cursor() -> None:
    kept = thinned(list(range(0, 1_000_000, 500)), 64, 500_000)
    near = [b - a for a, b in pairwise(kept) if abs(a - 500_000) < 20_000]
    far = [b - a for a, b in pairwise(kept) if abs(a - 500_000) > 300_000]
    assert near
    assert max(near) * 4 < min(far)


@given(st.integers(0, 10**6), st.integers(1, 10**6))
def test_a_ladder_lies_between_start_and_goal(start: int, way: int) -> None:
    rungs = Checkpoints(1).ladder(start, start + way)
    assert rungs == sorted(rungs)
    assert all(start < rung < start + way for rung in rungs)
    assert (way >= 2 * max(LADDER)) == (len(rungs) == len(LADDER))
