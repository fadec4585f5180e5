"""The systematic search comes to every end that some order has, in far fewer runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rsltrace.search.explore.outcome import TrialOptions
from rsltrace.search.explore.strategies.systematic import Systematic
from rsltrace.search.explore.trial import JobSource, Trial, TrialResult
from rsltrace.search.explore.workers import Worker

RUNS_MAX = 500
SENDER = "{{node: nodes_under_search:Sender, name: {0}, parameters: {{value: {1}, topic: {2}}}}}"
LAST = "{node: nodes_under_search:Last}"
RELAY = "{{node: nodes_under_search:Relay, name: {0}, parameters: {{from: {1}, to: {2}}}}}"
TWO = [SENDER.format("one", 1, "a"), SENDER.format("two", 2, "b")]
APART = [SENDER.format("one", 1, "c"), SENDER.format("two", 2, "d")]
RELAYS = [*APART, RELAY.format("three", "c", "a"), RELAY.format("four", "d", "b")]
GRAPHS = {
    "apart": (APART, 0.25),
    "one who minds": ([SENDER.format("one", 1, "a"), LAST], 0.15),
    "two and one who minds": ([*TWO, LAST], 0.15),
    "one topic": ([SENDER.format("one", 1, "a"), SENDER.format("two", 2, "a"), LAST], 0.15),
    "two rounds": ([SENDER.format("one", 1, "a"), LAST], 0.35),
    "relays": ([*RELAYS[1:3], LAST], 0.15),
}


def all_orders(run: Callable[[list[dict[str, int]]], TrialResult]) -> dict[str, int]:
    """Run every order there is; return how often each end was come to."""
    ends: dict[str, int] = {}
    waiting: list[list[dict[str, int]]] = [[]]
    while waiting:
        departures = waiting.pop()
        found = run(departures)
        ends[found.final_state] = ends.get(found.final_state, 0) + 1
        assert sum(ends.values()) < RUNS_MAX
        first = departures[-1]["choice"] + 1 if departures else 0
        for choice, (_, count) in enumerate(found.order[first:], first):
            waiting += [[*departures, {"choice": choice, "run": n}] for n in range(1, count)]
    return ends


def compare(path: Path, tmp_path: Path) -> tuple[Systematic, dict[str, int]]:
    """Search a job both ways."""
    with Worker(JobSource(str(path))) as worker:

        def run(departures: list[dict[str, int]]) -> TrialResult:
            trial = Trial(0, {"policy": {"departures": departures}})
            found = worker.run(
                trial, tmp_path / "run.mcap", TrialOptions(behaviours=True, steps=True)
            )
            assert found.failure is None
            return found

        ends = all_orders(run)
        strategy = Systematic()
        strategy.begin(run([]))
        while (proposal := strategy.propose(0)) is not None:
            found = run(proposal.overlay["policy"]["departures"])
            strategy.learn(found)
    assert strategy.finished
    return strategy, ends


@pytest.mark.long
@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("state", [False, True])
def test_every_end_is_come_to(
    write_job: Callable[[str, str], Path], tmp_path: Path, name: str, state: bool
) -> None:
    nodes, duration = GRAPHS[name]
    listed = "\n".join(f"  - {node}" for node in nodes)
    text = f"nodes:\n{listed}\nstop: {{duration: {duration}s}}\n"
    path = write_job("graph", text + ("guard: {state: true}\n" if state else ""))
    strategy, ends = compare(path, tmp_path)
    print(name, state, strategy.runs, sum(ends.values()), len(ends))
    assert strategy.finals == set(ends)
    assert strategy.runs <= sum(ends.values())
    if name in ("apart", "two and one who minds"):
        assert 2 * strategy.runs < sum(ends.values())
