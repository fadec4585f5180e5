"""The systematic search against all orders, of small models made up by hypothesis."""

from __future__ import annotations

from typing import Any

from hypothesis import assume, given, settings
from hypothesis import strategies as st

from rsltrace.search.explore.strategies.systematic import Systematic
from rsltrace.search.explore.trial import Trial, TrialResult, TrialStep
from tests.tiers import cases

NODES = 3
ORDERS_MAX = 400

Model = list[tuple[int, int, int | None]]
"""Callbacks: the node of each, what it adds there, and to which other it sends a message."""


def run(model: Model, begin: list[int], departures: dict[int, int]) -> TrialResult:
    """Run a model, in whose first phase ``begin`` are ready. Its callbacks do not commute in a
    node; a message is the value of the node that has sent it."""
    values = [1] * NODES
    queues: dict[int, list[int]] = {}
    ready: list[int] = []
    counts = [0] * len(model)
    steps: list[TrialStep] = []
    order: list[tuple[int, int]] = []

    def arrive(callback: int, message: int) -> None:
        queues.setdefault(callback, []).append(message)
        ready.append(callback)

    for callback in begin:
        arrive(callback, 0)
    while ready:
        here: dict[int, int] = {}
        names = []
        for callback in ready:
            here[callback] = here.get(callback, -1) + 1
            names.append(f"c{callback} #{counts[callback] + here[callback]}")
        chosen = 0
        if len(ready) > 1:
            chosen = departures.get(len(order), 0)
            order.append((chosen, len(ready)))
        callback = ready.pop(chosen)
        node, number, target = model[callback]
        values[node] = (values[node] * 31 + number + 7 * queues[callback].pop(0)) % 1_000_003
        touches = {f"n{node}": True, f"t{callback}": False}
        if target is not None and counts[callback] < 1:
            touches[f"t{target}"] = True
            arrive(target, values[node])
        counts[callback] += 1
        steps.append(TrialStep(tuple(names), chosen, 0, touches, "begin"))
    overlay = {"policy": {"departures": [{"choice": c, "run": r} for c, r in departures.items()]}}
    trial = Trial(0, overlay)
    return TrialResult(trial, final_state=str(values), order=tuple(order), steps=tuple(steps))


callbacks = st.tuples(st.integers(0, NODES - 1), st.integers(0, 5), st.none() | st.integers(0, 4))


@settings(max_examples=cases(15, 100), deadline=None)
@given(
    st.lists(callbacks, min_size=5, max_size=5), st.lists(st.integers(0, 4), min_size=2, max_size=4)
)
def test_it_comes_to_all_ends(model: Model, begin: list[int]) -> None:
    ends: set[str] = set()
    orders = 0
    waiting: list[dict[int, int]] = [{}]
    while waiting:
        departures = waiting.pop()
        found = run(model, begin, departures)
        ends.add(found.final_state)
        orders += 1
        assume(orders <= ORDERS_MAX)
        for choice in range(max(departures, default=-1) + 1, len(found.order)):
            waiting += [{**departures, choice: n} for n in range(1, found.order[choice][1])]
    strategy = Systematic()
    strategy.begin(run(model, begin, {}))
    while (proposal := strategy.propose(0)) is not None:
        taken: list[dict[str, Any]] = proposal.overlay["policy"]["departures"]
        strategy.learn(run(model, begin, {one["choice"]: one["run"] for one in taken}))
    assert strategy.finished
    assert strategy.finals == ends
    assert strategy.runs <= orders
