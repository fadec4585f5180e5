"""``--force`` never empties what the run reads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import OutputError
from rsltrace.job import load_job
from rsltrace.run import record

TALK = "nodes: [{node: nodes_under_test:Talker}]\nstop: {duration: 2s}\n"


@pytest.mark.long
@pytest.mark.parametrize(
    ("more", "output", "what"),
    [
        ("policy: {recorded: first.mcap}", "first.mcap", "policy.recorded"),
        ("policy: {recorded: first.mcap}", "link.mcap", "policy.recorded"),
        ("bags: [bag]", "bag/bag.mcap", "a bag of the job"),
        ("bags: [bag/bag.mcap]", "bag/bag.mcap", "a bag of the job"),
    ],
)
def test_what_a_job_reads_is_not_overwritten(
    job_file: Callable[..., Path], tmp_path: Path, more: str, output: str, what: str
) -> None:
    from rsltrace.trace.recordings.export import export_bag

    first = tmp_path / "first.mcap"
    record(load_job(job_file(TALK)), first)
    export_bag(first, tmp_path / "bag")
    next((tmp_path / "bag").glob("*.mcap")).rename(tmp_path / "bag" / "bag.mcap")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    (tmp_path / "link.mcap").symlink_to(first)
    before = (tmp_path / output).read_bytes()
    job = load_job(job_file(f"{TALK}{more}\n"))
    with pytest.raises(OutputError, match=rf"the run reads it \({what}\)"):
        record(job, tmp_path / output, force=True)
    assert (tmp_path / output).read_bytes() == before
    record(job, tmp_path / "other.mcap")


def test_the_recording_whose_answers_are_given_again(
    job_file: Callable[..., Path], tmp_path: Path
) -> None:
    job: Any = load_job(job_file(TALK + "guard: {random: record}\n"))
    first = tmp_path / "first.mcap"
    record(job, first)
    before = first.read_bytes()
    with pytest.raises(OutputError, match="recorded answers"):
        record(job, first, force=True, replay=first)
    assert first.read_bytes() == before
