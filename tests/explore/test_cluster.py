"""Trials on a cluster: what is sent, and runs on a scheduler and workers started by command."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rsltrace.errors import ExploreError
from rsltrace.search.explore.cluster import bundle_of
from rsltrace.search.explore.outcome import TrialOptions
from rsltrace.search.explore.trial import JobSource, Trial, TrialResult

pytest.importorskip("distributed", reason="needs Dask: pip install 'rsltrace[explore]'")

ROBOT = """
from rclpy.node import Node
from std_msgs.msg import Int32

class Talker(Node):
    def __init__(self):
        super().__init__("talker")
        self.publisher = self.create_publisher(Int32, "n", 10)
        self.number = 0
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.number += 1
        self.publisher.publish(Int32(data=self.number))

class Watcher(Node):
    def __init__(self):
        super().__init__("watcher")
        self.last = 0
        self.publisher = self.create_publisher(Int32, "seen", 10)
        self.create_subscription(Int32, "n", lambda m: setattr(self, "last", m.data), 10)
        self.create_timer(0.1, lambda: self.publisher.publish(Int32(data=self.last)))
"""
JOB = """
nodes:
  - {node: robot:Talker}
  - {node: robot:Watcher, parameter_files: [../shared/watcher.yaml]}
search_path: [src]
stop: {duration: 250ms}
checks: [never: /seen.data == 0]
"""


@pytest.fixture
def job(tmp_path: Path) -> Path:
    """Make a job whose files lie in two folders."""
    for name, text in (
        ("robot/src/robot.py", ROBOT),
        ("robot/src/__pycache__/robot.pyc", "x"),
        ("robot/src/old.mcap", "x"),
        ("robot/job.yaml", JOB),
        ("shared/watcher.yaml", "/**: {ros__parameters: {unused: 1}}"),
    ):
        path = tmp_path / "here" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path / "here" / "robot" / "job.yaml"


def test_a_bundle_has_what_the_job_needs_and_is_the_job_elsewhere(job: Path) -> None:
    bundle = bundle_of(JobSource(str(job), (("--set", "seed=5"),)))
    assert sorted(bundle.files) == ["robot/src/robot.py", "shared/watcher.yaml"]
    there = job.parents[2] / "there"
    bundle.unpack(there)
    shutil.rmtree(job.parents[1])
    moved = bundle.source(there).job()
    assert moved.seed == 5
    assert moved.resolve("src/robot.py").read_text() == ROBOT
    assert Path(moved.base_dir) == there / "robot"


def test_the_hash_of_a_bundle_is_that_of_its_content(job: Path) -> None:
    def now() -> str:
        return bundle_of(JobSource(str(job))).hash

    before = now()
    os.utime(job.parent / "src" / "robot.py", (1, 1))
    assert now() == before
    (job.parent / "src" / "robot.py").write_text(ROBOT + "# other\n")
    assert now() != before


def test_a_large_file_must_be_there(job: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsltrace.search.explore.cluster.SHIPPED_MAX", 100)
    bundle = bundle_of(JobSource(str(job)))
    assert list(bundle.large) == ["robot/src/robot.py"]
    bundle.unpack(job.parents[2] / "a")
    assert (job.parents[2] / "a" / "robot/src/robot.py").read_text() == ROBOT
    (job.parent / "src" / "robot.py").unlink()
    with pytest.raises(ExploreError, match="same path on each"):
        bundle.unpack(job.parents[2] / "b")


# -- on a cluster ----------------------------------------------------------------------------------


class Dask:
    """A scheduler and workers, started by command."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "scheduler.json"
        self._folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []
        where = ["--scheduler-file", str(self.file), "--no-dashboard"]
        self.start("scheduler", "--host", "127.0.0.1", "--port", "0", *where)
        self.workers = [self.add_worker() for _ in range(2)]

    def start(self, *words: str) -> subprocess.Popen[bytes]:
        one = subprocess.Popen(
            [sys.executable, "-m", "dask", *words],
            cwd=self._folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._processes.append(one)
        return one

    def add_worker(self) -> subprocess.Popen[bytes]:
        words = ["--scheduler-file", str(self.file), "--nthreads", "1", "--no-dashboard"]
        return self.start("worker", *words, "--no-nanny", "--local-directory", str(self._folder))

    def close(self) -> None:
        for one in self._processes:
            if one.poll() is None:
                os.killpg(one.pid, signal.SIGKILL)
            one.wait()


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Dask]:
    folder = tmp_path / "dask"
    folder.mkdir()
    started = Dask(folder)
    try:
        end = time.monotonic() + 300
        while not started.file.exists():
            assert time.monotonic() < end, "the scheduler does not start"
            time.sleep(0.1)
        yield started
    finally:
        started.close()


def trials(count: int) -> list[Trial]:
    return [
        Trial(number, {"seed": number, "policy": "permutation"}, f"seed {number}")
        for number in range(count)
    ]


@pytest.mark.long
@pytest.mark.ros
def test_workers_that_die_lose_nothing_and_runs_are_those_of_this_machine(
    job: Path, dask: Dask, tmp_path: Path
) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    from rsltrace.search.explore.cluster import Cluster
    from rsltrace.search.explore.workers import Worker

    source = JobSource(str(job))
    asked = trials(16)
    found: dict[int, TrialResult] = {}
    with Cluster(source, str(dask.file)) as cluster:
        waiting = list(reversed(asked))
        end = time.monotonic() + 500
        while waiting or cluster.busy:
            assert time.monotonic() < end
            while waiting and cluster.idle > 0:
                trial = waiting.pop()
                cluster.submit(trial, tmp_path / f"{trial.number}.mcap", TrialOptions())
            for one in cluster.results(5):
                assert one.trial.number not in found
                found[one.trial.number] = one
                if len(found) == 4:
                    os.killpg(dask.workers[0].pid, signal.SIGKILL)
                    dask.add_worker()
    assert sorted(found) == list(range(16))
    assert not list(tmp_path.glob("dask/**/rsltrace-*/*")) or dask.workers[0].poll() is not None
    with Worker(source) as here:
        for trial in asked[:6]:
            local = here.run(trial, tmp_path / "local.mcap", TrialOptions())
            there = found[trial.number]
            assert there.digest == local.digest
            assert there.failure == local.failure
    failed = [one for one in found.values() if one.failure is not None]
    assert 0 < len(failed) < 16
    kept = [one for one in failed if one.trace is not None]
    assert kept
    assert all(Path(one.trace or "").is_file() for one in kept)


def test_a_cluster_that_is_not_there(
    job: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rsltrace.search.explore import cluster

    monkeypatch.setattr(cluster, "_CONNECT_S", 1)
    monkeypatch.delenv("DASK_SCHEDULER_ADDRESS", raising=False)
    for address, said in (
        ("tcp://127.0.0.1:1", "cannot be used"),
        (str(tmp_path / "no.json"), "no scheduler file"),
        ("dask", "names no scheduler"),
    ):
        with pytest.raises(ExploreError, match=said), cluster.Cluster(JobSource(str(job)), address):
            raise AssertionError("it is there")
