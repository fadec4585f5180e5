"""A divergence is found where it was put: faults planted at random events of random runs.

Each case is a random job (fan-in, fan-out, services, feedback loops, a bag), run twice, the second
time with one fault. The diff has to name the event, the entity, the verdict and the root, and must
claim no other independent divergence. ``make test-all`` tries many of each kind.
"""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from diff_faults import PLANTERS, Planted, bounded_plan, plant, storages
from diff_simulator import MS, Fault, Simulation
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rsltrace.diff.alignment.blocks import AlignedBlock, AlignedBlocks
from rsltrace.diff.alignment.entity_matching import match_entities
from rsltrace.diff.alignment.rows import ComparedTrace
from rsltrace.diff.causes.propagation import Propagation
from rsltrace.diff.facts.causes import Verdict
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import Diff
from rsltrace.diff.traces.diff import diff_traces
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace
from tests.tiers import cases

CASES = cases(3, 20)
pytestmark = pytest.mark.repeated
SEEDS = st.integers(0, 2**32 - 1)


def diffed(planted: Planted, options: DiffOptions) -> Diff:
    with Trace.open(planted.a) as a, Trace.open(planted.b) as b:
        return diff_traces(a, b, options)


@pytest.mark.parametrize("kind", PLANTERS)
def test_a_planted_fault_is_found(kind: str, tmp_path: Path) -> None:
    tried: Counter[str] = Counter()

    @settings(max_examples=CASES, deadline=None, suppress_health_check=list(HealthCheck))
    @given(SEEDS, st.sampled_from([50, 300, 2000]), st.booleans())
    def found(seed: int, window: int, everything: bool) -> None:
        planted = plant(kind, random.Random(seed), tmp_path)
        if planted is None:  # the job has no room for such a fault
            tried["skipped"] += 1
            return
        tried["planted"] += 1
        diff = diffed(planted, DiffOptions(window=window, everything=everything))
        wrong = planted.check(diff)
        assert not wrong, f"{kind}, seed {seed}: {wrong}\n{planted.note}\n{diff.sentence}"
        tried["right"] += 1

    found()
    print(f"{kind}: {tried['right']} of {tried['planted']} right, {tried['skipped']} skipped")
    assert tried["planted"] > 0


@settings(max_examples=2 * CASES, deadline=None, suppress_health_check=list(HealthCheck))
@given(SEEDS)
def test_a_silent_change_of_state_shows_in_its_own_node(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    """A node's state goes wrong without a trace; what parts is the node's next visible act."""
    folder, rng = tmp_path_factory.mktemp("state"), random.Random(seed)
    plan, clean = bounded_plan(rng, folder)
    full = {node.name for node in plan.nodes if node.memory == "all"}
    suitable = [e for e in clean.log if e.node in full and e.kind is not EventKind.BAG]
    if not suitable:
        return
    event = rng.choice(suitable)
    Simulation(plan, folder / "b.mcap", (Fault("state", event.index),)).run()
    with Trace.open(folder / "a.mcap") as a, Trace.open(folder / "b.mcap") as b:
        diff = diff_traces(a, b)
    if diff.identical:
        return  # it never acted on its state again
    first = diff.divergences[0]
    assert diff.verdict is Verdict.SAME_INPUT_DIFFERENT_OUTPUT, diff.sentence
    assert first.a is not None
    assert first.a.entity.node == event.node
    assert diff.agreeing == first.a.index > event.index
    assert len(diff.divergences) == 1


@settings(max_examples=CASES, deadline=None, suppress_health_check=list(HealthCheck))
@given(SEEDS)
def test_a_second_fault_outside_of_the_cone_is_found_too(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    """Two changed outputs: the second is a divergence of its own if nothing led to it."""
    folder, rng = tmp_path_factory.mktemp("two"), random.Random(seed)
    plan, clean = bounded_plan(rng, folder)
    able = [e for e in clean.log if e.outputs and e.kind is not EventKind.BAG]
    if len(able) < 2:
        return
    first, second = sorted(rng.sample(able, 2), key=lambda event: event.index)
    one = Simulation(plan, folder / "one.mcap", (Fault("bit", first.index),)).run()
    same = [e for e in one.log if e.index == second.index]
    both = (Fault("bit", first.index), Fault("bit", second.index))
    Simulation(plan, folder / "b.mcap", both).run()
    with Trace.open(folder / "a.mcap") as a, Trace.open(folder / "one.mcap") as b:
        events_a = {int(e["index"]): e for part in a.events() for e in part}
        events_b = {int(e["index"]): e for part in b.events() for e in part}
    touched = {
        event.node
        for event in clean.log
        if event.index <= second.index and _differs(events_a, events_b, event.index)
    }
    if not same or same[0].entity != second.entity or second.node in touched:
        return
    if _differs(events_a, events_b, second.index):
        return
    with Trace.open(folder / "a.mcap") as a, Trace.open(folder / "b.mcap") as b:
        diff = diff_traces(a, b, DiffOptions(everything=True))
    found = {d.a.index for d in diff.divergences if d.a is not None}
    assert found == {first.index, second.index}, diff.divergences


def _check_order(a: Trace, b: Trace, start: int, window: int) -> None:
    """All events from ``start`` on are listed once, by the time at which either run did them."""
    matching = match_entities(a, b)
    blocks = AlignedBlocks(
        ComparedTrace(a, matching, False), ComparedTrace(b, matching, True), start, window
    )
    items = [i for block in blocks if isinstance(block, AlignedBlock) for i in block.items]
    times_a, times_b = _times(a), _times(b)
    times = [min(times_a[i.a : i.a + 1] + times_b[i.b : i.b + 1]) for i in items]
    assert times == sorted(times)
    for times, mine in ((times_a, [i.a for i in items]), (times_b, [i.b for i in items])):
        assert sorted(i for i in mine if i >= 0) == list(range(start, len(times)))


def _times(trace: Trace) -> list[int]:
    """Return when the events were, but -1 for the constructors before all others."""
    events = [event for part in trace.events() for event in part]
    is_construct = [event["kind"] == EventKind.CONSTRUCT for event in events]
    first = is_construct.index(False) if False in is_construct else len(events)
    return [-1] * first + [int(event["stamp"]) for event in events[first:]]


def _differs(a: dict[int, object], b: dict[int, object], index: int) -> bool:
    names = ("stamp", "entity", "kind", "input_hash", "output_hash")
    mine, theirs = a.get(index), b.get(index)
    if mine is None or theirs is None:
        return True
    return any(mine[name] != theirs[name] for name in names)  # type: ignore[index]


@pytest.mark.long
def test_the_check_bites(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sabotage: an engine that knows no consequences is caught by the cases above."""
    monkeypatch.setattr(Propagation, "_explanation", lambda *_: (None, None))
    wrong = 0
    for seed in range(12):
        planted = plant("bit", random.Random(seed), tmp_path)
        if planted is not None:
            wrong += bool(planted.check(diffed(planted, DiffOptions())))
    assert wrong > 3


@pytest.mark.long
@settings(max_examples=2 * CASES, deadline=None, suppress_health_check=list(HealthCheck))
@given(SEEDS, st.sampled_from([5, 50, 500]))
def test_every_event_is_counted_once_whatever_the_runs_are(
    tmp_path_factory: pytest.TempPathFactory, seed: int, window: int
) -> None:
    """Two runs of other graphs, lengths and bags, with several faults: it only has to add up."""
    folder, rng = tmp_path_factory.mktemp("any"), random.Random(seed)
    plan, _ = bounded_plan(rng, folder)
    other = plan
    if rng.random() < 0.3:
        other, _ = bounded_plan(rng, folder)
    elif rng.random() < 0.5:
        nodes = tuple(rng.sample(plan.nodes, len(plan.nodes)))
        bag = tuple(message for message in plan.bag if rng.random() < 0.8)
        other = replace(plan, nodes=nodes, bag=bag, end_ns=plan.end_ns + rng.choice((0, MS)))
    layouts = storages(rng)
    kinds = ("bit", "drop", "late", "extra")
    faults = [Fault(rng.choice(kinds), rng.randrange(10, 400), delay_ns=MS) for _ in range(3)]
    Simulation(plan, folder / "a.mcap", storage=layouts[0]).run()
    try:
        Simulation(other, folder / "b.mcap", tuple(faults), layouts[1]).run()
    except IndexError:  # there was nothing yet that could come again
        return
    with Trace.open(folder / "a.mcap") as a, Trace.open(folder / "b.mcap") as b:
        diff = diff_traces(a, b, DiffOptions(window=window, everything=True))
        left = a.event_count - diff.agreeing, b.event_count - diff.agreeing
        _check_order(a, b, diff.agreeing, window)
    if diff.counts:  # not if one run is the beginning of the other
        assert sum(c.matching + c.differing + c.only_a for c in diff.counts) == left[0]
        assert sum(c.matching + c.differing + c.only_b for c in diff.counts) == left[1]
