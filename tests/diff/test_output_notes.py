"""Small words of a report: durations, and what was put together in another order."""

from __future__ import annotations

import pytest

from rsltrace.diff.alignment.outputs import matched_outputs
from rsltrace.diff.causes.output_notes import durations
from rsltrace.model.event import OutputKind
from rsltrace.model.stamp import format_duration

MESSAGE = int(OutputKind.MESSAGE)


@pytest.mark.parametrize(
    ("duration_ns", "text"),
    [
        (12_500_000_000, "12.5 s"),
        (3_200_000, "3.2 ms"),
        (1_700_000_000_123_456_789, "1700000000.123456789 s"),
        (1_700_000_000_000_000_000, "1700000000 s"),
    ],
)
def test_a_duration_is_short_and_a_time_since_1970_is_in_full(duration_ns: int, text: str) -> None:
    assert format_duration(duration_ns) == text


def test_two_durations_share_a_unit() -> None:
    assert durations(20_000_000, 26_000_000) == "20 → 26 ms"
    assert durations(900_000, 2_000_000) == "900 us → 2 ms"


def test_outputs_in_another_order_are_told_once_and_the_same_in_both_directions() -> None:
    one, other = (MESSAGE, 1, 11, 0), (MESSAGE, 2, 22, 0)
    there = list(matched_outputs([one, other], [other, one]))
    back = list(matched_outputs([other, one], [one, other]))
    assert all(moved for *_, moved in there + back)
    assert {row[1][1] for row in there if row[1]} == {row[1][1] for row in back if row[1]} == {1, 2}


def test_what_moved_and_what_is_new_are_told_apart() -> None:
    one, other, new = (MESSAGE, 1, 11, 0), (MESSAGE, 2, 22, 0), (MESSAGE, 3, 33, 0)
    found = list(matched_outputs([one, other], [other, one, new]))
    assert [(x, y) for _, x, y, moved in found if not moved] == [(None, new)]
