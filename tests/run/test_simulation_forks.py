"""A simulation that goes on in several ways: each as if it had been run from the beginning."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rclpy.node import Node  # noqa: E402
from std_msgs.msg import Int32  # noqa: E402

from rsltrace.errors import JobError, OutputError, RunError  # noqa: E402
from rsltrace.job import Job, NodeSpec, StopSpec  # noqa: E402
from rsltrace.run import Simulation, record  # noqa: E402
from rsltrace.trace.reader import Trace  # noqa: E402


@pytest.fixture(autouse=True)
def nothing_left_by_other_tests() -> None:
    """A process that shares memory cannot fork; what is left of runs with processes may be garbage
    that nobody has collected."""
    gc.unfreeze()
    gc.collect()


class Counter(Node):
    def __init__(self) -> None:
        super().__init__("counter")
        self.count = 0
        self.publisher = self.create_publisher(Int32, "count", 10)
        self.create_subscription(Int32, "add", self.add, 10)
        self.create_timer(0.1, self.tick)

    def add(self, message: Any) -> None:
        self.count += message.data

    def tick(self) -> None:
        if self.count < 0:
            raise ValueError("less than nothing")
        self.count += 1
        self.publisher.publish(Int32(data=self.count))


class Listener(Node):
    def __init__(self) -> None:
        super().__init__("listener")
        self.heard: list[int] = []
        self.create_subscription(Int32, "count", lambda m: self.heard.append(m.data), 10)


def job(**more: Any) -> Job:
    specs = [NodeSpec(node=Counter), NodeSpec(node=Listener)]
    return Job(nodes=specs, stop=StopSpec(duration=1.05), **more)


def adding(number: int) -> Any:
    def drive(sim: Simulation) -> list[int]:
        sim.publish("/add", Int32(data=number))
        sim.run()
        heard: list[int] = sim.node("listener").heard
        return heard

    return drive


@pytest.mark.long
def test_a_process_that_has_closed_its_output_forks_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python has None in its place."""
    monkeypatch.setattr(sys, "stdout", None)
    with Simulation(job(), forks=True) as sim:
        assert sim.fork(adding(10)).value[-1] == 20


@pytest.mark.long
def test_each_fork_is_the_run_from_the_beginning_and_the_original_stays(tmp_path: Path) -> None:
    with Simulation(job(), tmp_path / "original.mcap", forks=True) as sim:
        sim.run_for(0.5)
        digest, heard = sim.digest, list(sim.node("listener").heard)
        forks = {n: sim.fork(adding(n), tmp_path / f"forked{n}.mcap") for n in (10, 20)}
        plain = sim.fork(lambda sim: sim.run(), tmp_path / "plain.mcap")
        nested = sim.fork(lambda sim: (sim.run_for(0.2), sim.fork(adding(10)).value)[1])
        assert (sim.digest, sim.node("listener").heard, sim.now_ns) == (digest, heard, 500_000_000)
        sim.run()
    for number, fork in forks.items():
        assert fork.value == [1, 2, 3, 4, 5, *range(6 + number, 11 + number)]
        with Simulation(job(), tmp_path / f"whole{number}.mcap") as whole:
            whole.run_for(0.5)
            adding(number)(whole)
        assert replace(fork.result, path=None) == replace(whole.result, path=None)
        traces = [(tmp_path / f"{name}{number}.mcap").read_bytes() for name in ("forked", "whole")]
        assert traces[0] == traces[1]
    assert nested.value == [1, 2, 3, 4, 5, 6, 7, 18, 19, 20]
    record(job(), tmp_path / "recorded.mcap")
    recorded = (tmp_path / "recorded.mcap").read_bytes()
    assert (tmp_path / "plain.mcap").read_bytes() == recorded
    assert (tmp_path / "original.mcap").read_bytes() == recorded
    assert plain.result.digest == sim.result.digest
    assert not list(tmp_path.glob("*unfinished*"))


@pytest.mark.long
def test_faults_of_a_fork_are_those_of_a_job_that_has_them(tmp_path: Path) -> None:
    faults = [{"drop": "/count", "message": 7}]
    with Simulation(job(), forks=True) as sim:
        sim.run_for(0.5)
        fork = sim.fork(lambda sim: sim.run(), tmp_path / "forked.mcap", faults=faults)
        with pytest.raises(RunError, match=r"cannot fork: it has a fault up to 0\.5"):
            sim.fork(lambda sim: sim.run(), faults=[{"drop": "/count", "message": 5}])
        with pytest.raises(JobError, match="which message of /count"):
            sim.fork(lambda sim: sim.run(), faults=[{"drop": "/count"}])
    assert fork.result.digest == record(job(faults=faults), tmp_path / "whole.mcap").digest
    assert (tmp_path / "forked.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()


@pytest.mark.long
def test_what_goes_wrong_in_a_fork_is_raised_and_the_original_goes_on(tmp_path: Path) -> None:
    there = tmp_path / "there.mcap"
    there.write_bytes(b"mine")
    before = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    with before, Simulation(job(), forks=True) as sim:
        sim.run_for(0.25)
        with pytest.raises(RunError, match="less than nothing"):
            sim.fork(adding(-100), tmp_path / "failed.mcap")
        with pytest.raises(ZeroDivisionError):
            sim.fork(lambda sim: 1 // 0)
        with pytest.raises(RunError, match="cannot leave the copy"):
            sim.fork(lambda sim: sim)
        with pytest.raises(RunError, match="killed by SIGKILL"):
            sim.fork(lambda sim: os.kill(os.getpid(), 9))
        with pytest.raises(OutputError):
            sim.fork(lambda sim: sim.run(), there)
        sim.run()
        assert before.stdin is not None
        before.stdin.close()  # it is not of the simulation, and has been there all the time
    assert there.read_bytes() == b"mine"
    assert sim.result.events == record(job(), None).events
    with Trace.open(tmp_path / "failed.mcap") as trace:
        assert trace.complete


@pytest.mark.long
def test_who_cannot_fork_says_why(tmp_path: Path) -> None:
    with Simulation(job()) as sim, pytest.raises(RunError, match="made with forks=True"):
        sim.fork(lambda sim: None)
    with Simulation(job(), forks=True) as sim:
        with (
            open(tmp_path / "file", "w+", encoding="utf-8"),
            pytest.raises(RunError, match="open for reading and writing"),
        ):
            sim.fork(lambda sim: None)
        sim.run()
        with pytest.raises(RunError, match="the run is over"):
            sim.fork(lambda sim: None)
