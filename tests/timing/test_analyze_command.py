"""``rsltrace analyze``: tables, JSON, exit statuses, and what it cannot analyze."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click import UsageError

pytest.importorskip("rclpy")

from rsltrace.cli.analyze import analyze
from rsltrace.errors import JobError, RsltraceError
from rsltrace.job import load_job
from rsltrace.run import record

pytestmark = pytest.mark.ros

PIPELINE = """
from rclpy.node import Node
from std_msgs.msg import Empty

class Source(Node):
    def __init__(self):
        super().__init__("source")
        self.out = self.create_publisher(Empty, "/data", 10)
        self.create_timer(0.02, self.tick)

    def tick(self):
        self.out.publish(Empty())

class Sink(Node):
    def __init__(self):
        super().__init__("sink")
        self.create_subscription(Empty, "/data", lambda message: None, 10)
        self.create_timer(0.1, self.slow)

    def slow(self):
        pass
"""
JOB = """
nodes: [{node: pipeline:Source}, {node: pipeline:Sink}]
executors: single_threaded
policy: rate_monotonic
execution:
  default: 1ms
  entities: [{node: /sink, entity: Sink.slow, uniform: {min: 4ms, max: 6ms}}]
stop: {duration: 0.5s}
"""


@pytest.fixture
def job(tmp_path: Path) -> Path:
    (tmp_path / "pipeline.py").write_text(PIPELINE)
    (tmp_path / "job.yaml").write_text(JOB)
    return tmp_path / "job.yaml"


def run(*words: Any) -> int:
    with pytest.raises(SystemExit) as ended:
        analyze.main([str(word) for word in words], standalone_mode=False)
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_bounds_and_what_was_seen_of_each_chain(
    job: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By hand: 6 ms of blocking, then 1 + 1 ms; the slow timer after both."""
    record(load_job(job), job.parent / "run.mcap")
    assert run(job, job.parent / "run.mcap", "--format", "json") == 0
    found = json.loads(capsys.readouterr().out)
    fast, slow = found["chains"]
    assert fast["name"] == "/source Source.tick → /data (/sink)"
    assert (fast["bound_ns"], fast["deadline_ns"]) == (8_000_000, 20_000_000)
    assert fast["simulated"]["runs"] >= 24
    assert slow["bound_ns"] == 8_000_000
    assert found["executors"] == {"executors[0]": pytest.approx(0.16)}
    assert run(job, job.parent / "run.mcap", "--deadline", "/data=7ms") == 1
    said = capsys.readouterr().out
    assert "may miss its deadline of 7 ms: it takes up to 8 ms" in said
    assert run(job, job.parent / "run.mcap", "--deadline", "1ms") == 1
    assert "misses its deadline of 1 ms: it took" in capsys.readouterr().out


@pytest.mark.long
def test_without_a_trace_the_job_is_run_and_may_be_drawn(
    job: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    picture = job.parent / "bounds.svg"
    words = ("--set", "policy=fifo", "--one-processor", "--plot", picture)
    assert run(job, *words) == 0
    assert "every chain meets its deadline" in capsys.readouterr().out
    assert picture.read_text().startswith("<?xml")


@pytest.mark.few(30)
@pytest.mark.parametrize(
    ("words", "change", "error", "message"),
    [
        (["--deadline", "/nowhere=1ms"], "", JobError, "no chain ends in /nowhere"),
        (["--reservation", "5ms/2ms"], "", UsageError, "is not a reservation"),
        (["--times", "max", "--set", "seed=1"], "", UsageError, "times of callbacks are unknown"),
        ([], "min_time_step: 1ms\n", JobError, "time moves on in steps"),
        (
            ["--plot", "picture.txt"],
            "",
            RsltraceError,
            "must end in .png, .svg, .pdf",
        ),
    ],
)
def test_what_cannot_be_analyzed_is_said(
    job: Path, words: list[str], change: str, error: type[Exception], message: str
) -> None:
    job.write_text(change + JOB)
    with pytest.raises(error, match=message):
        analyze.main([str(job), *words], standalone_mode=False)
