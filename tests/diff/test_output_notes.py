"""Small words of a report: durations, and what was put together in another order."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.diff.alignment.outputs import matched_outputs
from rsltrace.diff.alignment.rows import OutputRow
from rsltrace.diff.sentences.values import durations
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.texts import (
    contrasting_durations,
    contrasting_texts,
    format_duration,
    printable,
)
from rsltrace.trace.words.entities import EntityKey

MESSAGE = int(OutputKind.MESSAGE)
KEYS = [EntityKey("/node", "publisher", f"/t{number}", "a/msg/B") for number in range(4)]
OUTPUTS = st.lists(
    st.tuples(
        st.sampled_from((OutputKind.MESSAGE, OutputKind.LOG, OutputKind.DRAW)),
        st.integers(0, len(KEYS) - 1),
        st.integers(0, 3),
        st.just(0),
    ),
    max_size=8,
)


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


@pytest.mark.parametrize(
    ("a_ns", "b_ns", "text"),
    [
        (100_000_000, 100_000_100, "100 → 100.0001 ms"),
        (100_000_100, 100_000_000, "100.0001 → 100 ms"),
        (1_000_000_000, 1_000_000_001, "1 → 1.000000001 s"),
        (999_999_999, 1_000_000_000, "999.999999 ms → 1 s"),
        (86_400_000_000_001, 86_400_000_000_000, "86400.000000001 → 86400 s"),
    ],
)
def test_durations_that_differ_are_shown_so_that_one_sees_it(
    a_ns: int, b_ns: int, text: str
) -> None:
    assert durations(a_ns, b_ns) == text


@given(st.integers(0, 10**15), st.integers(-3, 3))
def test_two_durations_never_look_the_same(a_ns: int, more_ns: int) -> None:
    one, other = contrasting_durations(a_ns, a_ns + more_ns)
    assert (one == other) == (more_ns == 0)


@given(st.text(max_size=80), st.text(max_size=80))
def test_two_texts_never_look_the_same(a: str, b: str) -> None:
    prefix = "same " * 20
    one, other = contrasting_texts(prefix + a, prefix + b)
    assert max(len(one), len(other)) <= 40
    assert (one == other) == (printable(a) == printable(b))


def test_outputs_in_another_order_are_told_once() -> None:
    one, other = (MESSAGE, 1, 11, 0), (MESSAGE, 2, 22, 0)
    found = list(matched_outputs([one, other], [other, one], KEYS))
    assert all(moved for *_, moved in found)
    assert {row[1][1] for row in found if row[1]} == {1, 2}


def test_what_moved_and_what_is_new_are_told_apart() -> None:
    one, other, new = (MESSAGE, 1, 11, 0), (MESSAGE, 2, 22, 0), (MESSAGE, 3, 33, 0)
    found = list(matched_outputs([one, other], [other, one, new], KEYS))
    assert [(x, y) for _, x, y, moved in found if not moved] == [(None, new)]


def test_what_others_receive_comes_before_what_is_logged_in_its_place() -> None:
    sent, logged = (MESSAGE, 1, 11, 0), (int(OutputKind.LOG), 0, 22, 0)
    assert [x for _, x, _, _ in matched_outputs([sent], [logged], KEYS)] == [sent, None]
    assert [y for _, _, y, _ in matched_outputs([logged], [sent], KEYS)] == [sent, None]


@given(OUTPUTS, OUTPUTS, st.permutations(range(len(KEYS))))
def test_what_differs_is_the_same_whichever_run_is_a(
    a: list[OutputRow], b: list[OutputRow], numbers: list[int]
) -> None:
    """Also in its order, of which a sentence tells the beginning; numbers of entities go by a."""
    keys = [KEYS[numbers.index(number)] for number in range(len(KEYS))]

    def renumbered(outputs: list[OutputRow]) -> list[OutputRow]:
        return [(kind, numbers[number], content, 0) for kind, number, content, _ in outputs]

    def named(row: OutputRow | None, keys: list[EntityKey]) -> object:
        return row and (row[0], keys[row[1]], row[2])

    there = matched_outputs(a, b, KEYS)
    back = matched_outputs(renumbered(b), renumbered(a), keys)
    assert [(named(x, KEYS), named(y, KEYS), moved) for _, x, y, moved in there] == [
        (named(x, keys), named(y, keys), moved) for _, y, x, moved in back
    ]


@given(OUTPUTS, OUTPUTS)
def test_what_differs_makes_one_event_of_the_other(a: list[OutputRow], b: list[OutputRow]) -> None:
    left = Counter(a)
    for _, x, y, moved in matched_outputs(a, b, KEYS):
        if moved:
            assert x
            assert x == y
        else:
            left.subtract([x] if x else [])
            left.update([y] if y else [])
    assert +left == Counter(b)
    assert not -left
