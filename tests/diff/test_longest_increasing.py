"""The longest increasing subsequence, against all subsequences there are."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from rsltrace.diff.alignment.rows import longest_increasing


def rises(values: list[int]) -> bool:
    return all(early < late for early, late in itertools.pairwise(values))


@given(st.lists(st.integers(-1, 8), max_size=9))
def test_no_choice_in_order_has_more(values: list[int]) -> None:
    chosen = longest_increasing(values)
    assert rises([values[place] for place in sorted(chosen)])
    assert all(values[place] >= 0 for place in chosen)
    candidates = [value for value in values if value >= 0]
    most = max(
        count
        for count in range(len(candidates) + 1)
        for some in itertools.combinations(candidates, count)
        if rises(list(some))
    )
    assert len(chosen) == most
