"""Settings that vary: which values a search tries, and what a job may say of them."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsltrace.errors import ExploreError, JobError
from rsltrace.job import Job, NodeSpec, VarySpec, load_job
from rsltrace.search.explore.strategies.faults import FaultWalk
from rsltrace.search.explore.strategies.named import Variations, VaryWalk, check_vary
from rsltrace.search.explore.trial import JobSource, Trial, TrialResult
from tests.tiers import cases

A = Path(__file__).parents[2] / "sample_traces" / "nondeterministic_callback" / "a.mcap"


def all_of(spec: VarySpec, seed: int = 0) -> list[dict[str, Any]]:
    variations = Variations(spec, seed)
    found = list(itertools.takewhile(bool, (variations.at(n) for n in range(300))))
    return [one for one in found if one is not None]


def test_a_grid_has_every_combination_once_and_the_last_setting_changes_first() -> None:
    spec = VarySpec(
        settings={
            "a": [1, "x"],
            "b": {"uniform": [0.0, 1.0], "steps": 3},
            "c": {"integers": [4, 5]},
            "d": {"log_uniform": ["1ms", "100ms"], "steps": 3},
        },
        method="grid",
    )
    times = ["1000000ns", "10000000ns", "100000000ns"]
    expected = itertools.product([1, "x"], [0.0, 0.5, 1.0], [4, 5], times)
    assert [tuple(one.values()) for one in all_of(spec)] == list(expected)
    assert Variations(spec).count == 36


@settings(max_examples=cases(10, 30))
@given(st.integers(1, 60), st.integers(0, 5))
def test_a_latin_hypercube_has_one_run_in_each_stratum_of_each_setting(n: int, seed: int) -> None:
    pytest.importorskip("scipy")
    spec = VarySpec(
        settings={"a": {"uniform": [-1.0, 3.0]}, "b": {"log_uniform": [0.01, 100]}, "c": [7, 8]},
        method="latin_hypercube",
        samples=n,
    )
    found = all_of(spec, seed)
    assert found == all_of(spec, seed)
    assert len(found) == n
    assert sorted(int((one["a"] + 1) / 4 * n) for one in found) == list(range(n))
    assert all(0.01 <= one["b"] <= 100 for one in found)
    assert abs(sum(one["c"] == 7 for one in found) - n / 2) <= 1


def test_random_values_keep_to_their_ranges_and_depend_on_seed_and_number_alone() -> None:
    spec = VarySpec(
        settings={
            "a": {"uniform": ["1ms", "3ms"]},
            "b": {"normal": [10.0, 2.0]},
            "c": {"normal": ["1ms", "5ms"]},
            "d": {"integers": [1, 3]},
        }
    )
    found = all_of(spec, 4)
    assert len(found) == 300
    assert found[17] == Variations(spec, 4).at(17) != Variations(spec, 5).at(17)
    assert all(1_000_000 <= int(one["a"].removesuffix("ns")) <= 3_000_000 for one in found)
    assert 9 < sum(one["b"] for one in found) / 300 < 11
    assert min(one["c"] for one in found) == "0ns"
    assert {one["d"] for one in found} == {1, 2, 3}
    json.dumps(found)


@pytest.mark.parametrize(
    ("vary", "said"),
    [
        ({"settings": {}}, "nothing varies"),
        ({"settings": {"a b": [1]}}, "is no key of a job"),
        ({"settings": {"checks.0.name": ["x"]}}, "is the same in every run"),
        ({"settings": {"a": {"uniform": [1]}}}, "expected two values"),
        ({"settings": {"a": {"uniform": [1, "2ms"]}}}, "two numbers, or two times"),
        ({"settings": {"a": {"uniform": [2, 1]}}}, "greater than the first"),
        ({"settings": {"a": {"log_uniform": [0, 1]}}}, "must be more than 0"),
        ({"settings": {"a": {"integers": [0.5, 1]}}}, "expected two integers"),
        ({"settings": {"a": {"uniform": [0, 1], "normal": [0, 1]}}}, "give one of"),
        ({"settings": {"a": {"uniform": [0, 1]}}, "method": "grid"}, "how many values"),
        ({"settings": {"a": {"normal": [0, 1]}}, "method": "grid"}, "a grid has no normal"),
        ({"settings": {"a": [1]}, "method": "grid", "samples": 3}, "as many combinations"),
    ],
)
def test_what_makes_no_sense_is_refused(vary: dict[str, Any], said: str) -> None:
    with pytest.raises(JobError, match=said):
        Job(nodes=[NodeSpec(node="m:N")], vary=vary)


def test_a_setting_that_the_job_cannot_have_is_told_with_its_line(
    write_job: Callable[[str, str], Path],
) -> None:
    def checked(setting: str) -> None:
        path = write_job(
            "varied",
            "nodes: [{node: 'nodes_under_search:Last'}]\nvary:\n  settings:\n"
            f"    nodes.0.parameters.x: [1, 2]\n    {setting}\n",
        )
        check_vary(JobSource(str(path)), load_job(path))

    checked("stop.duration: {uniform: [1s, 2s]}")
    with pytest.raises(JobError, match=r"varied.yaml:5:\d+: .*stop.duratoin cannot be 1"):
        checked("stop.duratoin: {uniform: [1, 2]}")
    with pytest.raises(JobError, match=r"seed cannot be -1"):
        checked("seed: [3, -1]")
    path = write_job("plain", "nodes: [{node: 'nodes_under_search:Last'}]\n")
    with pytest.raises(ExploreError, match="has no vary:"):
        check_vary(JobSource(str(path)), load_job(path))


def test_strategies_propose_the_same_for_the_same_number() -> None:
    job = Job(
        nodes=[NodeSpec(node="m:N")],
        faults=[{"crash": "/a", "at": "1s"}],
        vary={"settings": {"seed": [1, 2]}, "method": "grid"},
    )
    walk = VaryWalk(job)
    assert [walk.propose(number) for number in (1, 2, 3)] == [
        ({"set": {"seed": 1}}, "seed = 1"),
        ({"set": {"seed": 2}}, "seed = 2"),
        None,
    ]
    assert walk.coverage() == ["settings (grid): 2 of 2 combinations of seed"]
    faults = FaultWalk(job, 3)
    faults.begin(TrialResult(Trial(0, {}), trace=str(A)))
    kinds = set()
    for number in range(1, 200):
        proposal = faults.propose(number)
        assert proposal is not None
        trial = job.replace(faults=proposal.overlay["faults"])
        assert trial.faults[0] == job.faults[0]
        kinds |= {fault.kind for fault in trial.faults[1:]}
        assert all(not fault.name.startswith("/rosout") for fault in trial.faults)
    assert kinds == {"crash", "hang", "restart", "drop", "delay", "duplicate"}
    assert faults.propose(7) == faults.propose(7)
    assert "faults: 201 runs" in faults.coverage()[0]
