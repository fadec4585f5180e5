"""Trials in workers do what ``rsltrace record`` of their written-out jobs does."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import ExploreError
from rsltrace.explore.outcome import Wants
from rsltrace.explore.trial import JobSource, Trial, overrides_of, result_of
from rsltrace.explore.workers import Worker
from rsltrace.job import load_job

OVERLAYS: list[dict[str, Any]] = [
    {},
    {"policy": {"departures": []}},
    {"policy": {"departures": [{"choice": 0, "run": 2}, {"choice": 2, "run": 1}]}},
    {"policy": {"pct": {"depth": 2, "choices": 8}}, "seed": 3},
    {"policy": "permutation", "seed": 4, "until": "0.3s"},
    {"set": {"nodes.0.parameters.value": 7, "x-said": "$(env HOME) ä"}},
]


def test_a_trial_is_the_record_of_its_written_out_job(
    worker: Worker, searched: Path, tmp_path: Path, command: Callable[..., Any]
) -> None:
    source = JobSource(str(searched / "job.yaml"))
    digests = []
    for number, overlay in enumerate(OVERLAYS):
        trial = Trial(number, overlay)
        found = worker.run(trial, tmp_path / f"{number}.mcap", Wants())
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
def test_workers_do_not_grow_and_leave_nobody_behind(searched: Path, tmp_path: Path) -> None:
    with Worker(JobSource(str(searched / "job.yaml"))) as worker:
        sizes = []
        for number in range(60):
            trial = Trial(number, {"policy": "permutation", "seed": number})
            worker.run(trial, tmp_path / "run.mcap", Wants(behaviours=True))
            assert worker._process is not None
            status = Path(f"/proc/{worker._process.pid}/status").read_text()
            sizes.append(int(status.split("VmRSS:")[1].split()[0]))
        children = Path(f"/proc/{worker._process.pid}/task/{worker._process.pid}/children")
        assert children.read_text() == ""
        pid = worker._process.pid
    assert sizes[-1] - sizes[20] < 1024  # kB
    assert not Path(f"/proc/{pid}").exists()
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_a_worker_that_dies_is_replaced_and_its_trial_made_again(
    worker: Worker, tmp_path: Path
) -> None:
    first = worker.run(Trial(0, {}), tmp_path / "run.mcap", Wants())
    assert worker._process is not None
    os.kill(worker._process.pid, signal.SIGKILL)
    again = worker.run(Trial(1, {}), tmp_path / "run.mcap", Wants())
    assert again.failure is None
    assert again.digest == first.digest


def test_a_job_that_cannot_run_is_no_result(worker: Worker, tmp_path: Path) -> None:
    wrong = Trial(5, {"set": {"nodes.0.node": "nodes_under_search:Nobody"}}, "a wrong node")
    with pytest.raises(ExploreError, match=r"trial 5 \(a wrong node\): .*Nobody"):
        worker.run(wrong, tmp_path / "run.mcap", Wants())
