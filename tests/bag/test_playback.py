"""Messages in the order of another time than the one they are stored by: exact, and lazy."""

from __future__ import annotations

from collections.abc import Iterator

from hypothesis import given
from hypothesis import strategies as st

from rsltrace.trace.recordings.playback import reordered
from rsltrace.trace.recordings.topic import BagMessage


@given(st.lists(st.integers(0, 50), max_size=60))
def test_reordering_is_a_stable_sort(stamps: list[int]) -> None:
    messages: list[BagMessage] = [(stamp, i, b"") for i, stamp in enumerate(stamps)]
    assert list(reordered(lambda: iter(messages))) == sorted(messages, key=lambda m: m[0])


def test_only_as_many_messages_wait_as_may_come_late() -> None:
    taken = 0

    def messages() -> Iterator[BagMessage]:
        nonlocal taken
        taken = 0
        for i in range(10_000):
            taken += 1
            yield i * 10 - (35 if i % 7 == 3 else 0), i, b""

    stream = reordered(messages)
    most = 0
    for given_out, _ in enumerate(stream, 1):
        most = max(most, taken - given_out)
    assert most < 12
