"""One-liners as users write them: the same in every run, or with a finding."""

from __future__ import annotations

from pathlib import Path

import pytest

from campaigns.one_liners.campaign import LIMITS, Judged, Line, all_lines, judge, run, write_job
from rsltrace import load_job, record

pytestmark = pytest.mark.ros

IN_ONE_PROCESS = ("random", "numpy", "hashes and addresses", "texts", "sets")
"""Topics that differ from run to run in one process, too."""


def _silent(judged: list[Judged]) -> list[Line]:
    return [one.line for one in judged if one.verdict == "silent"]


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_no_line_is_silent_in_one_process(tmp_path: Path) -> None:
    lines = [line for line in all_lines() if line.topic in IN_ONE_PROCESS]
    job = write_job(lines, tmp_path)
    traces, ballast = [], []
    for number in range(2):
        traces.append(tmp_path / f"{number}.mcap")
        record(load_job(job), traces[-1])
        ballast.append([object() for _ in range(9973)])  # other addresses next time
    judged = judge(lines, traces)
    assert _silent(judged) == []
    assert {one.verdict for one in judged} == {"held", "reported"}
    assert all(one.given[0] != "nothing" for one in judged)


@pytest.mark.long
def test_no_line_is_silent_in_perturbed_environments(tmp_path: Path) -> None:
    lines = all_lines()
    judged = run(lines, 2, tmp_path)
    assert len(lines) > 500
    assert {line.topic for line in _silent(judged)} <= {LIMITS}
