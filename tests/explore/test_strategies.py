"""What strategies propose follows from what they were told, and from nothing else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import ExploreError
from rsltrace.job import Job, NodeSpec
from rsltrace.search.explore.strategies.named import NAMES, Feedback, strategy_named
from rsltrace.search.explore.trial import Trial, TrialResult

JOB = Job(nodes=[NodeSpec(node="m:N")])


def result(number: int, overlay: dict[str, Any], new: int, order: Any) -> TrialResult:
    trial = Trial(number, overlay)
    return TrialResult(trial, choices=len(order), entities=3, behaviours=(0, new), order=order)


PLAIN = result(0, {"policy": {"departures": []}}, 1, ((0, 2), (0, 3)))


@pytest.mark.parametrize("name", sorted({*NAMES} & {"mixed", "pct", "random", "feedback"}))
def test_a_search_that_is_resumed_proposes_what_it_would_have_proposed(name: str) -> None:
    one, other = (strategy_named(name, JOB, seed=3) for _ in range(2))
    one.begin(PLAIN)
    other.begin(PLAIN)
    for number in range(1, 30):
        proposal = one.propose(number)
        assert proposal is not None
        ran = result(number, dict(proposal.overlay), number % 7, ((0, 2), (number % 3, 3)))
        other.recall(one.learn(ran) or ran)
    assert [one.propose(n) for n in range(30, 40)] == [other.propose(n) for n in range(30, 40)]


def test_feedback_departs_once_more_from_what_was_new() -> None:
    strategy = Feedback()
    strategy.begin(PLAIN)
    strategy.learn(result(1, {"seed": 9, "policy": "permutation"}, 2, ((1, 2), (2, 3), (0, 4))))
    strategy.learn(result(2, {}, 2, ((1, 2), (2, 3), (1, 9))))  # showed nothing new
    seen = set()
    for number in range(3, 200):
        proposal = strategy.propose(number)
        assert proposal is not None
        departures = [
            (one["choice"], one["run"]) for one in proposal.overlay["policy"]["departures"]
        ]
        if proposal.overlay.get("seed") == 9:
            before = [one for one in departures if one in ((0, 1), (1, 2))]
            assert len(departures) - len(before) <= 1
            assert departures[: len(before)] == [(0, 1), (1, 2)][: len(before)]
            seen.add(tuple(departures))
    assert {((0, 1), (1, 2), (2, run)) for run in (1, 2, 3)} <= seen
    assert all(choice < 3 and run < 4 for found in seen for choice, run in found)


def test_where_there_is_no_choice_feedback_draws_anew() -> None:
    strategy = Feedback()
    strategy.begin(result(0, {}, 1, ()))
    seeds = {str(strategy.propose(number)) for number in range(1, 9)}
    assert len(seeds) == 8


def test_of_one_choice_there_is_a_singular() -> None:
    strategy = strategy_named("pct", JOB)
    strategy.begin(result(0, {}, 1, ((0, 2),)))
    strategy.propose(0)
    assert strategy.coverage()[0].endswith("by these 1 (3 entities, 1 choice)")


@pytest.mark.long
def test_pct_meets_planted_orders_no_less_often_than_its_bound() -> None:
    script = Path(__file__).resolve().parents[2] / "benchmarks" / "explore_pct.py"
    done = subprocess.run(
        [sys.executable, script, "--runs", "1000"], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.strip("| ").split(" | ") for line in done.stdout.splitlines()[2:]]
    assert [row[0] for row in rows] == ["1", "2", "3"]
    for row in rows:
        assert float(row[5]) >= float(row[3]) > 0


def test_a_search_of_whole_callbacks_is_refused_where_lines_are_switched() -> None:
    job = Job(nodes=[NodeSpec(node="m:N")], threads="every_line")
    with pytest.raises(ExploreError, match="takes callbacks as whole"):
        strategy_named("systematic", job)
    assert strategy_named("mixed", job).propose(1) is not None
