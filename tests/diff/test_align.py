"""Which event is which: inserted, missing, moved and late events do not shift the others."""

from __future__ import annotations

import random

from hypothesis import example, given, settings
from hypothesis import strategies as st

from rsltrace.diff.alignment.align import NO_CAUSE, UNKNOWN, EarlierPairs, EventSequence, match
from tests.tiers import cases

# (stamp, input, cause, nth)
Row = tuple[int, int, int, int]


def sequence(rows: list[Row]) -> EventSequence:
    columns = list(zip(*rows, strict=True)) if rows else [(), (), (), ()]
    return EventSequence(*columns)


def pairs(a: list[Row], b: list[Row], *, surest_only: bool = False) -> set[tuple[int, int]]:
    found = match(sequence(a), sequence(b), surest_only=surest_only)
    assert len({i for i, _ in found}) == len({j for _, j in found}) == len(found)
    assert all(0 <= i < len(a) and 0 <= j < len(b) for i, j in found)
    return set(found)


def ticks(count: int, period: int = 10) -> list[Row]:
    """A timer: the input is the deadline, nothing causes it."""
    return [(n * period, 1000 + n * period, NO_CAUSE, 0) for n in range(1, count + 1)]


def messages(count: int, period: int = 10) -> list[Row]:
    return [(n * period, 5000 + n, 2 * n, 0) for n in range(1, count + 1)]


rows = st.lists(
    st.tuples(
        st.integers(0, 5).map(lambda n: n * 10),
        st.integers(0, 4),
        st.sampled_from([NO_CAUSE, UNKNOWN, 1, 2, 3, 4]),
        st.integers(0, 1),
    ),
    max_size=12,
).map(lambda drawn: sorted(drawn, key=lambda row: row[0]))


@given(rows, rows, st.booleans())
@example(
    [(10, 0, NO_CAUSE, 0), (10, 0, NO_CAUSE, 0), (10, 1, NO_CAUSE, 0)],
    [(10, 2, NO_CAUSE, 0), (10, 1, NO_CAUSE, 0), (10, 0, NO_CAUSE, 0)],
    False,
)
def test_pairs_are_one_to_one_and_symmetric(a: list[Row], b: list[Row], surest: bool) -> None:
    there = pairs(a, b, surest_only=surest)
    back = pairs(b, a, surest_only=surest)
    assert len(there) == len(back)


@given(rows)
def test_a_sequence_is_its_own_counterpart(a: list[Row]) -> None:
    assert pairs(a, a) == {(i, i) for i in range(len(a))}


@settings(max_examples=cases(30, 200))
@given(st.integers(1, 40), st.sets(st.integers(0, 39)), st.sets(st.integers(0, 39)), st.booleans())
def test_missing_and_extra_events_are_the_ones_left_over(
    count: int, missing: set[int], extra: set[int], timers: bool
) -> None:
    both = ticks(count) if timers else messages(count)
    missing = {place for place in missing if place < count}
    extra = {place for place in extra if place < count} - missing
    if timers:
        extra = set()  # a tick that is gone and one that is new could as well be one late tick
    a = [row for place, row in enumerate(both) if place not in extra]
    b = [row for place, row in enumerate(both) if place not in missing]
    if not timers:  # other state upstream: nothing but the cause tells which is which
        b = [(stamp, data + 10_000, cause, nth) for stamp, data, cause, nth in b]
    at_a = {row[0]: i for i, row in enumerate(a)}
    at_b = {row[0]: j for j, row in enumerate(b)}
    assert pairs(a, b) == {(at_a[stamp], at_b[stamp]) for stamp in at_a.keys() & at_b.keys()}


def test_events_that_changed_places_are_still_the_same() -> None:
    a = [(10, 1, 5, 0), (10, 2, 6, 0), (10, 3, 7, 0), (20, 4, 8, 0)]
    for seed in range(20):
        order = [0, 1, 2]
        random.Random(seed).shuffle(order)
        b = [a[place] for place in order] + [a[3]]
        assert pairs(a, b) == {(place, j) for j, place in enumerate(order)} | {(3, 3)}


def test_equal_messages_are_told_apart_by_their_causes() -> None:
    a = [(10, 1, 5, 0), (10, 1, 6, 0)]
    assert pairs(a, [(10, 1, 6, 0), (10, 1, 5, 0)]) == {(0, 1), (1, 0)}
    assert pairs(a, [(10, 1, 6, 0)]) == {(1, 0)}


def test_the_same_message_at_another_time_is_the_same_message() -> None:
    a = messages(6)
    late = [*a[:2], *a[3:5], (55, *a[2][1:]), a[5]]
    assert pairs(a, late) == {(0, 0), (1, 1), (2, 4), (3, 2), (4, 3), (5, 5)}


def test_a_late_timer_is_found_by_its_place() -> None:
    """Even when its deadline moved, so that it has neither time nor input in common."""
    a = ticks(5)
    b = [*a[:2], (33, 1033, NO_CAUSE, 0), *a[3:]]
    assert pairs(a, b) == {(i, i) for i in range(5)}
    shifted = [(stamp + 3, data + 3, cause, nth) for stamp, data, cause, nth in a]
    assert pairs(a, shifted) == {(i, i) for i in range(5)}


def test_what_is_far_off_is_another_event() -> None:
    """A tick that is missing early and one that is there late are not one late tick."""
    a, b = ticks(10), [*ticks(10)[1:], (110, 1110, NO_CAUSE, 0)]
    assert pairs(a, b) == {(i + 1, i) for i in range(9)}


def test_what_came_from_other_events_is_another_event() -> None:
    """The next request is not the lost one, however alike they are."""
    a, b = [(10, 7, 3, 0)], [(15, 7, 4, 0)]
    assert pairs(a, b) == set()
    assert pairs([(10, 7, UNKNOWN, 0)], b) == set()
    assert pairs([(10, 7, UNKNOWN, 0)], [(15, 7, UNKNOWN, 0)]) == {(0, 0)}


def test_constant_inputs_are_matched_by_time() -> None:
    a = [(n * 10, 42, NO_CAUSE, 0) for n in range(1, 8)]
    b = [*a[:3], *a[4:]]
    assert pairs(a, b) == {(0, 0), (1, 1), (2, 2), (4, 3), (5, 4), (6, 5)}


def test_long_sequences_of_others_take_no_square_of_time() -> None:
    a = [(n * 10, n, NO_CAUSE, 0) for n in range(5000)]
    b = [(n * 10 + 1, n + 10_000, NO_CAUSE, 0) for n in range(4990)]
    assert len(pairs(a, b)) == 4990


@given(
    st.integers(0, 5),
    st.dictionaries(st.integers(5, 9), st.integers(5, 9), max_size=4),
    st.tuples(st.integers(10, 13), st.integers(10, 13), st.integers(0, 4)),
)
def test_an_earlier_event_has_a_partner_exactly_if_it_is_somebodys(
    same_before: int, recent: dict[int, int], equal_run: tuple[int, int, int]
) -> None:
    past = EarlierPairs(same_before, recent, equal_run)
    partners = {past.in_a(index_b) for index_b in range(20)} - {UNKNOWN}
    assert {index_a for index_a in range(20) if past.has_partner(index_a)} == partners
