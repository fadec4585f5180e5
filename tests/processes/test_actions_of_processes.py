"""Actions between nodes of this process and processes: goals, feedback, results, cancelling."""

from __future__ import annotations

from pathlib import Path

import pytest

from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.logs import missing_servers

pytestmark = [pytest.mark.ros, pytest.mark.long]

HERE = Path(__file__).parent
JOB = """
nodes:
  - {{script: {here}/action_server.py, isolated: {server}}}
  - {{script: {here}/action_client.py, isolated: {client}}}
stop: {{duration: 1s}}
"""
SUCCEEDED, CANCELED = 4, 5
EXPECTED = {
    (250, "server True"),
    (250, "-1 accepted False"),
    (250, "3 accepted True"),
    (300, "3 feedback [0]"),
    (400, "3 feedback [0, 1]"),
    (500, "3 feedback [0, 1, 2]"),
    (500, f"3 result {SUCCEEDED} [0, 1, 2]"),
    (250, "30 accepted True"),
    (300, "30 feedback [0]"),
    (400, "30 feedback [0, 1]"),
    (500, "30 feedback [0, 1, 2]"),
    (600, "30 feedback [0, 1, 2, 3]"),
    (650, "cancelling 1"),
    (700, f"30 result {CANCELED} [0, 1, 2, 3]"),
}


@pytest.mark.parametrize(("server", "client"), [(True, False), (False, True), (True, True)])
def test_goals_feedback_results_and_cancelling_pass_between_processes(
    compiled: object, tmp_path: Path, server: bool, client: bool
) -> None:
    text = JOB.format(here=HERE, server=str(server).lower(), client=str(client).lower())
    (tmp_path / "job.yaml").write_text(text)
    job = load_job(tmp_path / "job.yaml")
    results = [run(job, tmp_path / f"{n}.mcap") for n in range(2)]
    assert [result.error for result in results] == [None, None]
    assert results[0].digest == results[1].digest
    with Trace.open(tmp_path / "0.mcap") as trace:
        said = [
            (stamp // 10**6, trace.decode("/said", data).data)  # type: ignore[attr-defined]
            for stamp, _, data in trace.messages("/said")
        ]
        assert missing_servers(trace.entities.values()) == ""
    assert set(said) == EXPECTED
    assert len(said) == len(EXPECTED)
