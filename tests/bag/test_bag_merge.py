"""The merge is a stable sort that opens a piece only when its time has come."""

from __future__ import annotations

from collections.abc import Iterator

from hypothesis import given
from hypothesis import strategies as st

from rsltrace.trace.recordings.topic import BagMessage, RecordingPart, merge

stamps = st.lists(st.integers(0, 30), max_size=8).map(sorted)
# A piece may start earlier than its first message: a start is a promise, not a message.
pieces = st.lists(st.tuples(stamps, st.integers(0, 5)), max_size=6)


def make(order: int, times: list[int], early: int = 0) -> RecordingPart:
    def read() -> Iterator[BagMessage]:
        return iter([(t, order, b"%d" % i) for i, t in enumerate(times)])

    return RecordingPart(max(0, times[0] - early) if times else 0, order, read)


@given(pieces, st.randoms(use_true_random=False))
def test_the_result_is_sorted_by_time_piece_and_place(
    values: list[tuple[list[int], int]], random: object
) -> None:
    made = [make(order, times, early) for order, (times, early) in enumerate(values)]
    expected = sorted(
        (t, order, i) for order, (times, _) in enumerate(values) for i, t in enumerate(times)
    )
    random.shuffle(made)  # type: ignore[attr-defined]
    assert [(t, order, int(data)) for t, order, data in merge(made)] == expected


def test_a_piece_is_opened_when_its_time_has_come_and_not_before() -> None:
    opened: list[int] = []

    def piece(order: int, times: list[int]) -> RecordingPart:
        def read() -> Iterator[BagMessage]:
            opened.append(order)
            yield from ((t, order, b"") for t in times)

        return RecordingPart(times[0], order, read)

    messages = merge([piece(0, [0, 1, 5]), piece(1, [2, 3]), piece(2, [6])])
    assert opened == []
    assert [next(messages)[0] for _ in range(2)] == [0, 1]
    assert opened == [0]
    assert next(messages)[0] == 2
    assert opened == [0, 1]
    assert [t for t, _, _ in messages] == [3, 5, 6]
    assert opened == [0, 1, 2]
