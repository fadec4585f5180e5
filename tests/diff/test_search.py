"""Where two runs diverge: whatever their files look like, and with few reads."""

from __future__ import annotations

import itertools
import random
from pathlib import Path

import pytest
from diff_simulator import MS, Fault, NodePlan, Plan, Publication, Simulation, Storage
from hypothesis import given, settings
from hypothesis import strategies as st

from rsltrace.diff.alignment.divergence import first_difference
from rsltrace.errors import TraceError
from rsltrace.trace.mcap.source import FileSource
from rsltrace.trace.reader import Trace

CHAIN = Plan(
    (
        NodePlan("/source", timers=((MS, (Publication("/a"),)),)),
        NodePlan("/filter", subscriptions=(("/a", (Publication("/b"),)),)),
        NodePlan("/sink", subscriptions=(("/b", ()),)),
    ),
    end_ns=100 * MS,
)


def expected(a: Trace, b: Trace) -> int | None:
    """Return the answer by reading everything."""
    chains = [[int(h) for part in t.events() for h in part["chain_hash"]] for t in (a, b)]
    for index, (x, y) in enumerate(itertools.zip_longest(*chains)):
        if x != y:
            return index
    return None


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 350),
    st.sampled_from(["bit", "drop", "raise"]),
    st.tuples(st.sampled_from([1, 2, 7, 50, 4096]), st.sampled_from(["", "zstd"]), st.booleans()),
    st.tuples(st.sampled_from([1, 3, 10, 50, 4096]), st.sampled_from(["", "zstd"]), st.booleans()),
    st.booleans(),
)
def test_the_first_difference_is_that_of_a_linear_comparison(
    tmp_path_factory: pytest.TempPathFactory,
    at: int,
    kind: str,
    layout_a: tuple[int, str, bool],
    layout_b: tuple[int, str, bool],
    interrupted: bool,
) -> None:
    folder = tmp_path_factory.mktemp("search")
    Simulation(CHAIN, folder / "a.mcap", storage=Storage(*layout_a)).run()
    storage = Storage(*layout_b, close=not interrupted)
    Simulation(CHAIN, folder / "b.mcap", (Fault(kind, at),), storage).run()
    with Trace.open(folder / "a.mcap") as a, Trace.open(folder / "b.mcap") as b:
        assert b.complete is not interrupted
        assert first_difference(a, b) == first_difference(b, a) == expected(a, b)


def test_identical_runs_are_known_by_their_digests(tmp_path: Path) -> None:
    Simulation(CHAIN, tmp_path / "a.mcap").run()
    Simulation(CHAIN, tmp_path / "b.mcap", storage=Storage(13, "", False)).run()
    with Trace.open(tmp_path / "a.mcap") as a, Trace.open(tmp_path / "b.mcap") as b:
        before = a.bytes_read, b.bytes_read
        assert first_difference(a, b) is None
        assert (a.bytes_read, b.bytes_read) == before, "nothing is read for it"


@pytest.mark.few(1)
@pytest.mark.parametrize("per_segment", [(64, 64), (64, 61), (64, 5), (7, 300)])
def test_few_segments_are_read(tmp_path: Path, per_segment: tuple[int, int]) -> None:
    """As many as a binary search takes, and with equal segments no more than one of each file."""
    plan = Plan(CHAIN.nodes, end_ns=2000 * MS)
    Simulation(plan, tmp_path / "a.mcap", storage=Storage(per_segment[0], payloads=False)).run()
    for at in (10, 2000, 5900):
        fault = (Fault("drop", at),)
        storage = Storage(per_segment[1], payloads=False)
        Simulation(plan, tmp_path / "b.mcap", fault, storage).run()
        reads = []

        class Counting(FileSource):
            def read_at(self, offset: int, length: int) -> bytes:
                reads.append(offset)  # noqa: B023  # used within the iteration
                return super().read_at(offset, length)

        with Trace(Counting(tmp_path / "a.mcap")) as a, Trace(Counting(tmp_path / "b.mcap")) as b:
            reads.clear()
            assert first_difference(a, b) == at
            most = 2 if per_segment[0] == per_segment[1] else 2 * len(bin(len(a.segments)))
            assert len(reads) <= most, len(reads)


def test_a_run_that_is_the_beginning_of_another(tmp_path: Path) -> None:
    for events, close in ((4096, True), (10, False)):
        Simulation(CHAIN, tmp_path / "a.mcap").run()
        short = Plan(CHAIN.nodes, end_ns=50 * MS)
        Simulation(short, tmp_path / "b.mcap", storage=Storage(events, close=close)).run()
        with Trace.open(tmp_path / "a.mcap") as a, Trace.open(tmp_path / "b.mcap") as b:
            found = first_difference(a, b)
            assert found == expected(a, b)
            # A proper end destroys the nodes, which the longer run does later.
            assert found is not None
            assert found <= b.event_count


def test_runs_without_events(tmp_path: Path) -> None:
    empty = Plan((), end_ns=0)
    Simulation(empty, tmp_path / "empty.mcap").run()
    Simulation(CHAIN, tmp_path / "a.mcap").run()
    with Trace.open(tmp_path / "empty.mcap") as nothing, Trace.open(tmp_path / "a.mcap") as a:
        assert nothing.event_count == 0
        assert first_difference(nothing, nothing) is None
        assert first_difference(nothing, a) == first_difference(a, nothing) == 0


def test_a_damaged_segment_is_named(tmp_path: Path) -> None:
    Simulation(CHAIN, tmp_path / "a.mcap", storage=Storage(50, "", False)).run()
    Simulation(CHAIN, tmp_path / "b.mcap", (Fault("drop", 121),), Storage(50, "", False)).run()
    with Trace.open(tmp_path / "a.mcap") as a, Trace.open(tmp_path / "b.mcap") as b:
        diverges_at = expected(a, b)
        assert diverges_at is not None
        row = b.segments[diverges_at // 50]
        middle = int(row["events_offset"]) + int(row["events_length"]) // 2
    data = bytearray((tmp_path / "b.mcap").read_bytes())
    data[middle] ^= 1
    (tmp_path / "b.mcap").write_bytes(data)
    offset = int(row["events_offset"])
    with (
        Trace.open(tmp_path / "a.mcap") as a,
        Trace.open(tmp_path / "b.mcap") as b,
        pytest.raises(TraceError, match=rf"b\.mcap: the .*chunk at offset {offset} is damaged"),
    ):
        first_difference(a, b)


def test_hostile_random_places(tmp_path: Path) -> None:
    """Every place of a small run, with two layouts that share almost no end of a segment."""
    rng = random.Random(5)
    short = Plan(CHAIN.nodes, end_ns=10 * MS)
    count = len(Simulation(short, tmp_path / "a.mcap", storage=Storage(3)).run().log)
    for at in range(3, count):
        storage = Storage(rng.choice((1, 2, 4, 5)))
        Simulation(short, tmp_path / "b.mcap", (Fault("drop", at),), storage).run()
        with Trace.open(tmp_path / "a.mcap") as a, Trace.open(tmp_path / "b.mcap") as b:
            assert first_difference(a, b) == expected(a, b)
