"""A process with threads takes part like any other, with one result."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

JOB = """
nodes: [{{script: threaded.py, isolated: true}}]
stop: {{duration: 1s}}
{more}
"""


@pytest.mark.parametrize(
    "more",
    [
        "",
        pytest.param("policy: permutation", marks=pytest.mark.long),
        pytest.param("policy: rate_monotonic", marks=pytest.mark.long),
    ],
)
def test_threads_executors_sleeps_and_chance_are_the_same_in_every_run(
    compiled: object, tmp_path: Path, more: str
) -> None:
    shutil.copy(Path(__file__).parent / "threaded.py", tmp_path)  # its path decides what it draws
    (tmp_path / "job.yaml").write_text(JOB.format(more=more))
    job = load_job(tmp_path / "job.yaml")
    results = [run(job, tmp_path / f"{n}.mcap") for n in range(2)]
    assert [result.error for result in results] == [None, None]
    assert results[0].digest == results[1].digest
    with Trace.open(tmp_path / "0.mcap") as trace:
        said = [
            (stamp, trace.decode("/said", data).data)  # type: ignore[attr-defined]
            for stamp, _, data in trace.messages("/said")
        ]
    assert all(f"{stamp / 1e9:.3f}" == text.split()[0] for stamp, text in said)
    texts = [text for _, text in said]
    assert texts.count("0.100 slow begins") == 2  # both at once: the executor has threads
    assert texts.count("0.150 slow ends") == 2
    assert "0.150 watch 2" in texts
    assert sum(" work " in text for text in texts) == 8
