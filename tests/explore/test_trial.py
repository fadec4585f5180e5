"""Trials in workers do what ``rsltrace record`` of their written-out jobs does."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import ExploreError
from rsltrace.job import load_job
from rsltrace.search.explore.outcome import TrialOptions
from rsltrace.search.explore.trial import JobSource, Trial, overrides_of, result_of
from rsltrace.search.explore.workers import Worker

OVERLAYS: list[dict[str, Any]] = [
    {},
    {"policy": {"departures": []}},
    {"policy": {"departures": [{"choice": 0, "run": 2}, {"choice": 2, "run": 1}]}},
    {"policy": {"pct": {"depth": 2, "choices": 8}}, "seed": 3},
    {"policy": "permutation", "seed": 4, "until": "0.3s"},
    {"set": {"nodes.0.parameters.value": 7, "x-said": "$(env HOME) ä"}},
]


@pytest.mark.long
def test_a_trial_is_the_record_of_its_written_out_job(
    worker: Worker, searched: Path, tmp_path: Path, command: Callable[..., Any]
) -> None:
    source = JobSource(str(searched / "job.yaml"))
    digests = []
    for number, overlay in enumerate(OVERLAYS):
        trial = Trial(number, overlay)
        found = worker.run(trial, tmp_path / f"{number}.mcap", TrialOptions())
        assert found.failure is None
        assert found.trace is None
        assert not list(tmp_path.glob("*.mcap"))
        digests.append((found.digest, found.events))
        assert result_of(found.as_values()) == found
    assert digests[0] == digests[1]
    assert len(set(digests)) == len(digests) - 1
    for number in (2, 4):
        (searched / "written.yaml").write_text(source.job(Trial(0, OVERLAYS[number])).to_yaml())
        done = command(
            "record", searched / "written.yaml", "-q", "-o", tmp_path / "w.mcap", "--force"
        )
        assert f"digest {digests[number][0]}  events {digests[number][1]}" in done.stdout


def test_texts_are_not_replaced_when_they_are_read_again(searched: Path) -> None:
    trial = Trial(0, {"set": {"nodes.0.parameters.said": "$(env HOME) ä\n"}})
    job = load_job(searched / "job.yaml", overrides=list(overrides_of(trial)))
    assert job.nodes[0].parameters["said"] == "$(env HOME) ä\n"


@pytest.mark.long
@pytest.mark.parametrize("forks", [False, True])
def test_workers_do_not_grow_and_leave_nobody_behind(
    searched: Path, tmp_path: Path, *, forks: bool
) -> None:
    wants = TrialOptions(behaviours=True, fork_ns=50_000_000 if forks else -1)
    with Worker(JobSource(str(searched / "job.yaml"))) as worker:
        sizes = []
        for number in range(60):
            order = {"order": "permutation", "after": "50ms", "seed": number}
            found = worker.run(Trial(number, {"policy": order}), tmp_path / "run.mcap", wants, 300)
            assert found.is_forked == (forks and number > 0)
            assert worker._process is not None
            pid = worker._process.pid
            children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
            assert len(children) == found.is_forked  # the one with the prefix
            sizes.append([_rss_kb(one) for one in (pid, *children)])
    assert all(last - before < 512 for before, last in zip(sizes[20], sizes[-1], strict=True))
    deadline = time.monotonic() + 600
    while any(map(_runs, (pid, *children))):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert not list(tmp_path.iterdir())


def _runs(pid: object) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"  # who is dead may wait for somebody to look


def _rss_kb(pid: object) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0])


@pytest.mark.long
def test_a_worker_that_dies_is_replaced_and_its_trial_made_again(
    worker: Worker, tmp_path: Path
) -> None:
    first = worker.run(Trial(0, {}), tmp_path / "run.mcap", TrialOptions())
    assert worker._process is not None
    os.kill(worker._process.pid, signal.SIGKILL)
    again = worker.run(Trial(1, {}), tmp_path / "run.mcap", TrialOptions())
    assert again.failure is None
    assert again.digest == first.digest


@pytest.mark.long
def test_a_job_that_cannot_run_is_no_result(worker: Worker, tmp_path: Path) -> None:
    wrong = Trial(5, {"set": {"nodes.0.node": "nodes_under_search:Nobody"}}, "a wrong node")
    with pytest.raises(ExploreError, match=r"trial 5 \(a wrong node\): .*Nobody"):
        worker.run(wrong, tmp_path / "run.mcap", TrialOptions())
