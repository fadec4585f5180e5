"""Times that people type: from the start of the run, in every command, whenever that was."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import rsltrace
from rsltrace.checks.conditions.names import RunNames
from rsltrace.checks.conditions.text import parse_condition
from rsltrace.job import load_job
from rsltrace.job.values.times import TimeInRun, parse_time_in_run
from rsltrace.run import run
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

START_S = 1_700_000_000
NODE = """
from rclpy.node import Node
from std_msgs.msg import UInt64

class Source(Node):
    def __init__(self):
        super().__init__('source')
        self.out = self.create_publisher(UInt64, 'a', 10)
        self.create_timer(0.1, lambda: self.out.publish(UInt64(data=1)))
"""
JOB = f"""
nodes: [{{node: 'nodes_of_times:Source'}}]
start: {START_S}s
stop: {{duration: 5s}}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("times")
    (folder / "nodes_of_times.py").write_text(NODE)
    (folder / "job.yaml").write_text(JOB)
    run(load_job(folder / "job.yaml"), folder / "run.mcap")
    return folder


def ticks(path: Path) -> int:
    """Return how many timers have run."""
    with Trace.open(path) as trace:
        events = map(trace.event, range(trace.event_count))
        return sum(event.kind is EventKind.TIMER for event in events)


def command(folder: Path, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.few(1)
@pytest.mark.parametrize("time", ["2.5", "2500ms", f"@{START_S}.0", f"@{START_S + 2}.5s"])
def test_record_and_replay_mean_the_same_time(folder: Path, time: str) -> None:
    expected = 25 if "@" not in time or time.endswith("s") else 0
    said = command(folder, "record", "job.yaml", "-o", "part.mcap", "--force", "--until", time)
    assert ticks(folder / "part.mcap") == expected
    sim = f"sim {expected / 10:.9f}"
    assert sim in said
    replayed = command(folder, "replay", "run.mcap", "--until", time, "--trust")
    assert f"verified the first {expected + 1} events of 52, to {sim[4:]} s" in replayed
    assert sim in replayed
    listed = command(folder, "cat", "run.mcap", "--to", time, "--kind", "timer")
    assert len(listed.splitlines()) == expected


@pytest.mark.long
def test_edits_sessions_and_simulations_mean_the_same_time(folder: Path) -> None:
    branch = folder / "branch.mcap"
    for edit in ("2.45s: drop()", f"@{START_S + 2}.45s: drop()"):
        made = rsltrace.replay(
            folder / "run.mcap", edits=edit, output=branch, force=True, trust=True
        )
        assert made.verified == 25
        assert ticks(branch) == 49
    with rsltrace.DebugSession(folder / "run.mcap", trust=True) as session:
        assert session.go_to("2.5s").position.index == 26
        assert session.go_to(f"@{START_S + 1}s").position.index == 11
    with rsltrace.Simulation(folder / "job.yaml") as sim:
        sim.run_until(2.5)
        assert sim.now_ns == START_S * 10**9 + 2_500_000_000
        sim.run_until(f"@{START_S + 3}s")
        assert sim.now_ns == (START_S + 3) * 10**9


def test_a_time_is_read_with_or_without_a_start() -> None:
    assert parse_time_in_run(" 2.5 ") == TimeInRun(2_500_000_000)
    assert parse_time_in_run("@20ms") == TimeInRun(20_000_000, is_absolute=True)
    assert parse_time_in_run("1s").stamp_ns(7) == 1_000_000_007
    assert parse_time_in_run("@1s").stamp_ns(7) == 1_000_000_000
    for text in ("", "@", "soon", "@-1", "2@"):
        with pytest.raises(ValueError, match=r"."):
            parse_time_in_run(text)


def test_a_condition_takes_both(folder: Path) -> None:
    names = RunNames.__new__(RunNames)
    for text in ("t=2.5s", f"t=@{START_S}s"):
        assert parse_condition(text, names).text == text
