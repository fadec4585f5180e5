"""Going back is exact: from wherever one comes, states and the rest of the run are those of going
forward. Every event that is run again is compared with the trace, so a run that reaches its end has
done all that the recorded one did, with the same states."""

from __future__ import annotations

import importlib.util
import os
import random
from collections.abc import Callable
from pathlib import Path

import pytest

from campaigns.truth.graph import random_world
from rsltrace import DebugSession
from rsltrace.job import load_job
from rsltrace.run import record
from rsltrace.trace.reader import Trace
from tests.run.conftest import TALKER
from tests.run.test_recorded_order import ALL, MIXED

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[2]

KEEPS = """
import asyncio, random, threading
from pathlib import Path
from rclpy.node import Node
from std_msgs.msg import String

class Reader(Node):
    '''Reads a file line by line, draws, and keeps generators, iterators and an open file.'''
    def __init__(self):
        super().__init__('reader')
        self.file = Path(__file__).with_name('lines.txt').open()
        self.log = Path(__file__).with_name('log.txt').open('w')
        self.numbers = iter(range(10**6))
        self.seen = []
        self.lock = threading.Lock()
        self.out = self.create_publisher(String, 'lines', 10)
        self.create_timer(0.01, self.read)

    def read(self):
        with self.lock:
            line = self.file.readline().strip()
            self.seen.append((next(self.numbers), random.random()))
            self.log.write(line)
            self.log.flush()
            self.out.publish(String(data=f'{line} {self.seen[-1]}'))

    def destroy_node(self):
        self.file.close()
        self.log.close()
        super().destroy_node()

class Later(Node):
    '''Awaits what a loop of asyncio has done, in threads that wait for each other.'''
    def __init__(self):
        super().__init__('later')
        self.done = threading.Condition()
        self.count = 0
        threading.Thread(target=self.work, daemon=True).start()
        self.create_subscription(String, 'lines', self.got, 10)

    def got(self, message):
        with self.done:
            self.count += 1
            self.done.notify()
        if self.count % 10 == 0:
            asyncio.run(self.rest())

    async def rest(self):
        await asyncio.gather(asyncio.sleep(0.002), asyncio.sleep(0.001))
        self.get_logger().info(f'rested {self.count}')

    def work(self):
        while True:
            with self.done:
                self.done.wait()
                if self.count % 7 == 0:
                    self.get_logger().info(f'seven {self.count}')
"""


def _example(name: str, seconds: float) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        job = load_job(ROOT / name, overrides=[f"stop.duration={seconds}s", "guard.state=true"])
        record(job, folder / "run.mcap")
        return (ROOT / name).parent

    return write


def _job(text: str, code: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / "nodes_under_test.py").write_text(code)
        (folder / "lines.txt").write_text("".join(f"line {n}\n" for n in range(5000)))
        (folder / "job.yaml").write_text(text)
        record(load_job(folder / "job.yaml", overrides=["guard.state=true"]), folder / "run.mcap")
        return folder

    return write


def _actions(folder: Path) -> Path:
    programs = ("fibonacci_server", "fibonacci_client", "camera", "camera_manager")
    nodes = "".join(f"  - {{main: demo_interactions.{name}:main}}\n" for name in programs)
    demo = ROOT / "tests/demos/demo_interactions"
    text = f"nodes:\n{nodes}search_path: [{demo}]\nstop: {{duration: 5s}}\n"
    return _job(text, "")(folder)


def _graph(seed: int) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        world = random_world(random.Random(seed), bag=seed % 2 == 0, service=seed % 3 == 0)
        job = load_job(world.write(folder), overrides=["guard.state=true"])
        record(job, folder / "run.mcap")
        return folder

    return write


LINES = "nodes: [{node: nodes_under_test:Reader}, {node: nodes_under_test:Later}]\n"
JOBS = {
    "mains, threads, blocking calls": _job(ALL + "seed: 5\n", TALKER + MIXED),
    "files, draws, conditions, asyncio": _job(LINES + "stop: {duration: 1s}\n", KEEPS),
    "a graph with a bag": _graph(2),
    "arrays": _example("examples/sensor_fusion/job.yaml", 1),
}
MORE = {
    "actions, lifecycles": _actions,
    "a policy": _job(ALL + "policy: permutation\nseed: 5\n", TALKER + MIXED),
    "delays": _job(ALL + "delay: {default: {uniform: {min: 1ms, max: 30ms}}}\n", TALKER + MIXED),
    "execution times": _job(
        ALL + "executors: single_threaded\nexecution: {default: {normal: {mean: 3ms, sd: 1ms}}}\n",
        TALKER + MIXED,
    ),
    "benchmark8": _example("examples/benchmark8/job.yaml", 0.5),
    "heap order": _example("examples/rslcpp_determinism/job_heap.yaml", 8),
    **{f"graph {seed}": _graph(seed) for seed in range(3, 11)},
}


def check(folder: Path, job_folder: Path, positions: int, rng: random.Random) -> int:
    """Go to random positions, forwards and back, and from each of them on; return how many."""
    with (
        Trace.open(folder / "run.mcap") as trace,
        DebugSession(
            folder / "run.mcap", job_folder=job_folder, trust=True, checkpoints=rng.choice((4, 64))
        ) as session,
    ):
        count = trace.event_count
        for _ in range(positions):
            goal = rng.randint(1, count - 1)
            how = rng.choice((session.go_to, session.go_to, session.run_to))
            if how == session.run_to and goal < session.position.index:
                how = session.go_to
            position = how(goal).position
            event = trace.event(goal - 1)
            assert position.index == goal
            assert position.event is not None
            assert position.event["chain_hash"] == f"{event.chain_hash:016x}"
            assert position.event["state_hash"] == f"{event.state_hash:016x}"
            back = min(rng.randint(1, 20), goal - 1)
            if back:
                index = session.reverse_step(back).position.index
                assert index == goal - back
            stopped = session.go_on()
            assert (stopped.reason, stopped.position.index) == ("end", count), stopped
        assert session.checkpoints()["why_not"] == ""
    return positions


@pytest.mark.few(1)
@pytest.mark.parametrize("job", list(JOBS)[:2])
def test_at_random_positions_going_back_is_exact(job: str, tmp_path: Path) -> None:
    check(tmp_path, JOBS[job](tmp_path), 3, random.Random(job))


@pytest.mark.long
@pytest.mark.parametrize("job", {**JOBS, **MORE})
def test_at_many_random_positions_going_back_is_exact(job: str, tmp_path: Path) -> None:
    if job == "actions, lifecycles" and importlib.util.find_spec("test_msgs") is None:
        pytest.skip("needs ROS 2's test_msgs")
    positions = int(os.environ.get("RSLTRACE_POSITIONS", "30"))
    check(tmp_path, {**JOBS, **MORE}[job](tmp_path), positions, random.Random(job))


@pytest.mark.long
def test_a_run_that_the_size_of_its_trace_ended_ends_again(tmp_path: Path) -> None:
    (tmp_path / "ticking.py").write_text(
        "from rclpy.node import Node\n\n\nclass Ticking(Node):\n    def __init__(self):\n"
        "        super().__init__('ticking')\n        self.create_timer(0.001, lambda: None)\n"
    )
    job = tmp_path / "job.yaml"
    job.write_text("nodes: [{node: ticking:Ticking}]\nstop: {size: 200kB}\n")
    record(load_job(job), tmp_path / "run.mcap")
    with DebugSession(tmp_path / "run.mcap", trust=True) as session:
        stopped = session.go_on()
        assert (stopped.reason, stopped.text) == ("end", "a trace of 200kB")
