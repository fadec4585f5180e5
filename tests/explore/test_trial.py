"""Trials in workers do what ``rsltrace record`` of their written-out jobs does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

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
    for number in (0, 2, 3, 4):
        (searched / "written.yaml").write_text(source.job(Trial(0, OVERLAYS[number])).to_yaml())
        done = command(
            "record", searched / "written.yaml", "-q", "-o", tmp_path / "w.mcap", "--force"
        )
        assert f"digest {digests[number][0]}  events {digests[number][1]}" in done.stdout


def test_texts_are_not_replaced_when_they_are_read_again(searched: Path) -> None:
    trial = Trial(0, {"set": {"nodes.0.parameters.said": "$(env HOME) ä\n"}})
    job = load_job(searched / "job.yaml", overrides=list(overrides_of(trial)))
    assert job.nodes[0].parameters["said"] == "$(env HOME) ä\n"
