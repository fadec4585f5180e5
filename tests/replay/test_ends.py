"""Runs that were cut off, interrupted or failed replay as far as they went, and it is said."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rsltrace
from rsltrace.job import load_job
from rsltrace.run import RunCallbacks, run
from rsltrace.simulation.loop.stop import Stop
from rsltrace.trace.reader import Trace
from tests.replay.conftest import JOB
from tests.run.conftest import TALKER
from tests.run.test_recorded_order import ALL, MIXED

pytestmark = pytest.mark.ros


def test_a_trace_that_was_cut_off(recorded: Callable[..., Path], tmp_path: Path) -> None:
    whole = recorded(f"{JOB}record: {{segment_events: 16}}\n").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    with Trace.open(cut) as trace:
        assert not trace.complete
        count = trace.event_count
    assert count > 20
    result = rsltrace.replay(cut, trust=True)
    assert (result.verified, result.exit_code, result.is_whole) == (count, 0, False)
    assert result.ended == "the trace was cut off there"
    assert "the trace was cut off: it is replayed as far as it goes" in result.notes[0]
    cut.write_bytes(whole[:9000])
    with pytest.raises(rsltrace.RsltraceError, match="has no events to replay"):
        rsltrace.replay(cut, trust=True)


def interrupted(job: Path, path: Path, stop: Stop) -> Any:
    """Record a job and end it from outside in the middle of it."""
    ends: list[Callable[[Stop], None]] = []

    def end(now_ns: int, end_ns: int | None, events: int) -> None:
        if events > 1000:
            ends[0](stop)

    return run(load_job(job), path, observer=RunCallbacks(interrupt=ends.append, progress=end))


@pytest.mark.long
@pytest.mark.parametrize("stop", [Stop("interrupted", 130), Stop("terminated", 143)])
def test_an_interrupted_run(tmp_path: Path, stop: Stop) -> None:
    """Mains, threads and callbacks that wait are in the middle of something then."""
    (tmp_path / "nodes_under_test.py").write_text(TALKER + MIXED)
    (tmp_path / "job.yaml").write_text(ALL.replace("0.5s", "100s"))
    done = interrupted(tmp_path / "job.yaml", tmp_path / "run.mcap", stop)
    assert done.exit_code == stop.exit_code
    result = rsltrace.replay(tmp_path / "run.mcap", trust=True, output=tmp_path / "again.mcap")
    assert (result.exit_code, result.diverged, result.ended) == (0, False, stop.reason)
    assert (result.verified, result.digest) == (done.events, done.digest)
    assert (tmp_path / "again.mcap").read_bytes() == (tmp_path / "run.mcap").read_bytes()


DEADLOCK = """
def main():
    import rclpy
    from std_srvs.srv import Trigger
    rclpy.init()
    Node('waiting').create_client(Trigger, 'nobody').call(Trigger.Request())
"""


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("job", "code"),
    [
        (JOB, "class Watch(Watch):\n    def got(self, message): raise ValueError(message.data)\n"),
        (JOB, "class Watch(Watch):\n    def got(self, message): raise SystemExit(4)\n"),
        ("nodes: [{main: nodes_of_replay:main}]\n", DEADLOCK),
    ],
    ids=["a node raises", "a node exits", "a deadlock"],
)
def test_a_run_that_failed_fails_again(recorded: Callable[..., Path], job: str, code: str) -> None:
    trace = recorded(job, code)
    with Trace.open(trace) as opened:
        assert opened.result["exit_code"] != "0"
        events, reason = opened.event_count, opened.result["stop_reason"]
    result = rsltrace.replay(trace, trust=True)
    assert (result.exit_code, result.is_whole, result.verified) == (0, True, events)
    assert (result.ended, result.notes) == (reason, ())


def test_a_constructor_that_raised(recorded: Callable[..., Path]) -> None:
    trace = recorded(code="class Watch:\n    def __init__(self): raise OSError('no')\n")
    result = rsltrace.replay(trace, trust=True)
    assert result.is_whole
    assert "raised OSError: no" in str(result.error)


@pytest.mark.long
def test_a_simulation_that_somebody_drove(tmp_path: Path, recorded: Callable[..., Path]) -> None:
    """Where it was only stepped it replays to its end; what was done from outside cannot."""
    from std_msgs.msg import Float64

    recorded()
    for name, publishes in (("stepped", False), ("driven", True)):
        with rsltrace.Simulation(tmp_path / "job.yaml", tmp_path / f"{name}.mcap") as sim:
            sim.run_for(1.05)
            if publishes:
                sim.publish("/speed", Float64(data=1.0))
            sim.run_for(0.5)
    result = rsltrace.replay(tmp_path / "stepped.mcap", trust=True)
    assert (result.exit_code, result.is_whole) == (0, True)
    assert result.ended == "left by the driver of the simulation"
    result = rsltrace.replay(tmp_path / "driven.mcap", trust=True)
    assert (result.exit_code, result.is_whole) == (0, False)
    assert "was done by the driver of the simulation" in result.ended
    assert result.end_ns == 1_000_000_000


def test_a_replay_that_is_interrupted(recorded: Callable[..., Path], tmp_path: Path) -> None:
    recorded(
        "nodes: [{node: nodes_of_replay:Slow}]\nstop: {events: 3000}\n",
        "class Slow(Source):\n    def tick(self):\n        super().tick()\n"
        "        if self.count == 9: self.get_logger().info('it runs')\n"
        "        while self.count == 9 and os.path.exists('slow'): pass\n",
    )
    (tmp_path / "slow").touch()
    command = [sys.executable, "-m", "rsltrace", "replay", "run.mcap"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    assert "replaying run.mcap" in process.stderr.readline()
    assert any("it runs" in line for line in iter(process.stderr.readline, ""))
    process.send_signal(signal.SIGINT)
    (tmp_path / "slow").unlink()  # not before: it would be over if we were late
    out, _ = process.communicate(timeout=600)
    assert process.returncode == 130, out
    assert out.startswith("verified the first ")
    assert "(interrupted)" in out
