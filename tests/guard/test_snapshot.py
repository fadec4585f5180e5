"""States that are written as what is new in them are read as they were."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rsltrace.guard.state.snapshot
from rsltrace.guard.state.hashing import StateHasher
from rsltrace.guard.state.snapshot import Snapshots
from rsltrace.trace.cdr import pack_detail
from rsltrace.trace.format import TOPIC_STATES
from rsltrace.trace.reader import Trace
from rsltrace.trace.states import state_after

NODE = 7


class Written:
    """What a trace has of one node's states, and nothing else."""

    name = "run.mcap"

    def __init__(self, states: list[dict[str, Any]]) -> None:
        snapshots, hasher = Snapshots(), StateHasher()
        self.changes = []
        for state in states:
            hashes = {name: hasher.digest(value, name) for name, value in state.items()}
            self.changes.append(snapshots.changes(state, hashes))

    def messages(self, topic: str) -> Iterator[tuple[int, int, bytes]]:
        assert topic == TOPIC_STATES
        for event, changes in enumerate(self.changes):
            yield event, 0, pack_detail(event, NODE, json.dumps(changes))


def read(states: list[dict[str, Any]], event: int) -> dict[str, Any]:
    found = state_after(cast(Trace, Written(states)), NODE, event)
    return {p: leaf if isinstance(leaf, str) else leaf.tolist() for p, leaf in found.items()}


def large(numbers: list[int]) -> Any:
    """An array of three blocks, in which a few numbers are not 0."""
    made = np.zeros(1200)
    made[[number % 1200 for number in numbers]] = 1 + len(numbers)
    return made


ARRAYS = st.one_of(
    st.lists(st.sampled_from([0, 5, 700, 1199]), max_size=2).map(large),
    st.lists(st.integers(0, 2), max_size=3).map(lambda numbers: np.array(numbers, dtype=np.int32)),
)
PARTS = st.one_of(st.none(), st.integers(0, 3), ARRAYS)
VALUES = st.one_of(
    PARTS, st.dictionaries(st.sampled_from("xyz"), PARTS), st.lists(PARTS, max_size=6)
)
STATES = st.lists(st.dictionaries(st.sampled_from(["p", "q"]), VALUES), min_size=1, max_size=6)


@given(STATES)
def test_each_state_is_read_as_if_it_were_the_only_one(states: list[dict[str, Any]]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rsltrace.guard.state.snapshot, "LEAVES_MAX", 4)
        for event, state in enumerate(states):
            assert read(states, event) == read([state], 0)


def test_an_array_that_was_away_for_a_while_is_written_anew() -> None:
    array = np.arange(1000.0)
    states = [{"map": array}, {"map": None}, {"map": array}, {}, {"map": array}]
    assert [read(states, event).get("map") for event in range(5)] == [
        array.tolist(), "None", array.tolist(), None, array.tolist()
    ]  # fmt: skip


def test_of_an_array_that_stays_only_what_is_new_is_written() -> None:
    first, second = large([]), large([700])
    changes = Written([{"map": first}, {"map": second}]).changes
    assert list(changes[0]["map"]["map"]["blocks"]) == ["0", "1", "2"]
    assert list(changes[1]["map"]["map"]["blocks"]) == ["1"]


def test_what_is_gone_is_not_kept() -> None:
    snapshots, hasher = Snapshots(), StateHasher()
    for number in range(50):
        tracks = {number: np.full(100, number)}
        snapshots.changes({"tracks": tracks}, {"tracks": hasher.digest(tracks, "tracks")})
    assert [len(arrays) for arrays in snapshots._arrays.values()] == [1]
