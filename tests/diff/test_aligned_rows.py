"""Aligned rows: both runs in their own order, events that moved linked, values of both."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from diff_faults import PLANTERS, plant
from diff_simulator import MS, Fault, NodePlan, Plan, Publication, Simulation

from rsltrace.diff.alignment import blocks
from rsltrace.diff.alignment.aligned_rows import AlignedRow
from rsltrace.diff.row_sign import RowSign
from rsltrace.diff.traces import aligned_runs
from rsltrace.diff.traces.aligned_runs import AlignedRuns
from rsltrace.trace.reader import Trace

_COMPARED = ("kind", "input_hash", "output_hash", "flags", "state_hash")


@pytest.fixture(params=[2000, 30])
def per_block(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """How many events are aligned at once: with few, orders go on from block to block."""
    monkeypatch.setattr(aligned_runs, "_EVENTS_PER_BLOCK", request.param)
    if request.param < 100:
        monkeypatch.setattr(blocks, "_MARGIN_MIN", 20)
    return int(request.param)


def rows_of(runs: AlignedRuns) -> list[AlignedRow]:
    return [runs.rows.row(place) for place in range(runs.rows.count)]


def check(runs: AlignedRuns, a: Trace, b: Trace) -> None:
    """Check all that is true of any aligned rows."""
    rows, made = runs.rows, rows_of(runs)
    seen_a = [row.a for row in made if row.a is not None]
    seen_b = [row.b for row in made if row.b is not None]
    assert seen_a == list(range(a.event_count))
    assert seen_b == list(range(b.event_count))
    before_a = before_b = 0
    for place, row in enumerate(made):
        assert (rows.before(place, of_b=False), rows.before(place, of_b=True)) == (
            before_a,
            before_b,
        )
        before_a += row.a is not None
        before_b += row.b is not None
        for index, of_b in ((row.a, False), (row.b, True)):
            if index is not None:
                assert rows.place_of(index, of_b=of_b) == place
        if row.elsewhere is not None:
            there = rows.row(rows.place_of(row.elsewhere, of_b=row.b is None))
            assert row.sign in (RowSign.MOVED, RowSign.DIFFERS)
            if there.sign is not RowSign.UNKNOWN:
                assert (there.pair, there.sign) == (row.pair, row.sign)


def check_signs(runs: AlignedRuns, a: Trace, b: Trace) -> None:
    """Check the signs by the events, of runs whose entities have the same ids."""
    for row in rows_of(runs):
        if row.sign in (RowSign.ONLY_A, RowSign.ONLY_B):
            assert (row.a is None) == (row.sign is RowSign.ONLY_B)
            assert row.elsewhere is None
            continue
        event_a, event_b = (t.event(i or 0) for t, i in zip((a, b), row.pair, strict=True))
        alike = all(getattr(event_a, name) == getattr(event_b, name) for name in _COMPARED)
        assert alike == (row.sign is not RowSign.DIFFERS)
        if row.sign is RowSign.MATCH:
            assert event_a.stamp_ns == event_b.stamp_ns


@pytest.mark.few(8)
@pytest.mark.parametrize("kind", PLANTERS)
def test_planted_pairs(kind: str, tmp_path: Path, per_block: int) -> None:
    folders = [tmp_path / f"{seed}" for seed in range(4)]
    for folder in folders:
        folder.mkdir()
    planted = [plant(kind, random.Random(folder.name), folder) for folder in folders]
    assert any(planted)
    for one in planted:
        if one is None:
            continue
        with Trace.open(one.a) as a, Trace.open(one.b) as b:
            runs = AlignedRuns(a, b)
            check(runs, a, b)  # also where most is not compared yet
            while not runs.done:
                runs.take(runs.fetch())
                check(runs, a, b)
            assert all(row.sign is not RowSign.UNKNOWN for row in rows_of(runs))
            if runs.matching.same_ids:
                check_signs(runs, a, b)


TICKS = Plan((NodePlan("/clock", timers=((10 * MS, (Publication("/t"),)),)),), end_ns=3000 * MS)


def recorded(folder: Path, name: str, *faults: Fault, plan: Plan = TICKS) -> Trace:
    return Trace.open(Simulation(plan, folder / f"{name}.mcap", faults).run().path)


def aligned(a: Trace, b: Trace) -> AlignedRuns:
    runs = AlignedRuns(a, b)
    while not runs.done:
        runs.take(runs.fetch())
    check(runs, a, b)
    return runs


def test_what_is_late_from_some_time_on_has_not_moved(tmp_path: Path, per_block: int) -> None:
    late = Fault("late", 20, delay_ns=25 * MS, new_deadline=True)
    with recorded(tmp_path, "a") as a, recorded(tmp_path, "b", late) as b:
        runs = aligned(a, b)
        assert runs.rows.shifted
        assert all(row.elsewhere is None for row in rows_of(runs))


def test_events_that_swap_places_stand_in_both(tmp_path: Path) -> None:
    """a: left, right; b: right, left. One stays, the other has two rows that name each other."""
    plan = Plan(
        (
            NodePlan("/source", timers=((10 * MS, (Publication("/a"),)),)),
            NodePlan("/left", subscriptions=(("/a", (Publication("/l"),)),)),
            NodePlan("/right", subscriptions=(("/a", (Publication("/r"),)),)),
        ),
        end_ns=100 * MS,
    )
    left = 3 + 3 * 4 + 1
    swap = Fault("swap", left, which=1)
    with recorded(tmp_path, "a", plan=plan) as a, recorded(tmp_path, "b", swap, plan=plan) as b:
        runs = aligned(a, b)
        moved = [row for row in rows_of(runs) if row.elsewhere is not None]
        assert [row.pair for row in moved] == [(left, left + 1)] * 2 or [
            row.pair for row in moved
        ] == [(left + 1, left)] * 2
        assert {row.sign for row in moved} == {RowSign.MOVED}
        assert runs.rows.count == a.event_count + 1
        assert list(runs.rows.divergences) == [runs.first_place, (runs.first_place or 0) + 2]


def test_the_values_of_both(tmp_path: Path) -> None:
    with recorded(tmp_path, "a") as a, recorded(tmp_path, "b", Fault("bit", 20)) as b:
        runs = aligned(a, b)
        (first,) = runs.differences(20, 20)
        (field,) = first.fields
        assert (first.topic, field.path) == ("/t", "data")
        for trace, text in ((a, field.a), (b, field.b)):
            (output,) = trace.outputs_of(20)
            found = trace.payload(output)
            assert found is not None
            assert text == str(int.from_bytes(found[2][12:20], "little"))
