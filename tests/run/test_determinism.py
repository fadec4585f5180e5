"""One job, many machines' worth of differences, one digest.

Each run is a process of its own with another hash seed, working directory, locale, time zone,
address-space layout, heap and CPU load. Thirty-six of them in ``make test-all``.
"""

from __future__ import annotations

import hashlib
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rsltrace.search.perturb import LOAD, Perturbation, PerturbedRun, perturbation, record_perturbed
from tests.tiers import cases

pytestmark = [pytest.mark.ros, pytest.mark.repeated]

ROOT = Path(__file__).parents[2]
RUNS = cases(3, 36)
RUNS_OF_A_POLICY = cases(2, 5)
JOB = """
# All that a run may contain: topics, services, coroutines, parameters, logs, padding.
nodes:
  - {node: "nodes:NodeA"}
  - {node: "nodes:NodeB"}
  - {node: "nodes:NodeC"}
  - {node: "nodes:NodeD"}
  - {node: "extra:Mixed"}
search_path: [NETWORK, .]
stop: {duration: 2s}
"""
EXTRA = """
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import NavSatFix
from std_srvs.srv import Trigger

class Mixed(Node):
    def __init__(self):
        super().__init__('mixed')
        self.fix = self.create_publisher(NavSatFix, 'fix', 10)
        self.create_subscription(NavSatFix, 'fix', self.got, 10)
        self.client = self.create_client(Trigger, '/s1', callback_group=ReentrantCallbackGroup())
        self.create_timer(0.013, self.tick, callback_group=ReentrantCallbackGroup())
        self.n = 0

    async def tick(self):
        self.n += 1
        answer = await self.client.call_async(Trigger.Request())
        message = NavSatFix(latitude=float(int(answer.message) % 90))
        message.header.frame_id = 'f' * (self.n % 8 + 1)
        self.fix.publish(message)
        self.executor.create_task(lambda: self.get_logger().info(f'{self.n} {answer.message}'))

    def got(self, message):
        if not self.has_parameter(f'seen_{self.n}'):
            self.declare_parameter(f'seen_{self.n}', message.latitude)
"""


def quiet(number: int) -> Perturbation:
    """Perturbation in which nobody keeps a processor busy: half the work."""
    around = perturbation(number)
    return Perturbation(number, {k: v for k, v in around.values.items() if k != LOAD})


def recorded(around: Perturbation, job: Path, out: Path) -> PerturbedRun:
    """Record the job in surroundings of its own."""
    done = record_perturbed(around, [str(job)], out)
    assert done.exit_code == 0, done.errors
    left = [path for path in out.rglob("*.cwd/**/*") if path.is_file() and not path.is_symlink()]
    assert left == [], "a run leaves nothing behind but its trace"
    return done


def test_one_digest_and_identical_files_whatever_surrounds_the_run(tmp_path: Path) -> None:
    network = ROOT / "examples" / "rslcpp_determinism"
    (tmp_path / "extra.py").write_text(EXTRA)
    job = tmp_path / "job.yaml"
    job.write_text(JOB.replace("NETWORK", str(network)))
    with ThreadPoolExecutor(max_workers=2) as pool:
        around = map(perturbation, range(RUNS))
        runs = list(pool.map(lambda each: recorded(each, job, tmp_path), around))
    assert len({run.digest for run in runs}) == 1, runs
    files = {hashlib.sha256(run.path.read_bytes()).hexdigest() for run in runs}
    assert len(files) == 1


@pytest.mark.long
def test_the_check_above_would_notice(tmp_path: Path) -> None:
    """The same check, sabotaged: a node that looks at the order of a set of strings."""
    (tmp_path / "extra.py").write_text(
        "from rclpy.node import Node\n"
        "class Mixed(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('mixed')\n"
        "        self.get_logger().info(' '.join({'a', 'b', 'c', 'd', 'e', 'f'}))\n"
    )
    job = tmp_path / "job.yaml"
    job.write_text("nodes: [{node: 'extra:Mixed'}]\nstop: {duration: 1s}\nguard: false\n")
    assert len({recorded(quiet(number), job, tmp_path).digest for number in range(3)}) > 1


POLICIES = {
    "fifo": "policy: fifo\nexecutors: [{workers: 3}]",
    "priority": "policy: {priority: [{node: /node_b, priority: 2}, {group_of: /t1, priority: 1}]}",
    "rate_monotonic": "policy: rate_monotonic",
    "permutation": "policy: permutation",
    "own": "policy: {function: 'extra:LastFirst'}",
    "slow": "policy: rate_monotonic\nexecution: {default: {gamma: {mean: 100us, sd: 50us}}}\n"
    "delay: {default: {lognormal: {median: 1ms, sigma: 0.5}, drop: 0.1, duplicate: 0.05}}\n"
    "clocks: [{node: '*', offset: -1ms, random_jumps: {every: 100ms, most: 5ms}}]",
}
LAST_FIRST = """
class LastFirst:
    def choose(self, ready, moment):
        return len(ready) - 1
"""


def digests(tmp_path: Path, keys: str) -> dict[str, Path]:
    """Record under a policy in several surroundings; return the digests, and a trace of each."""
    (tmp_path / "extra.py").write_text(EXTRA + LAST_FIRST)
    job = tmp_path / "job.yaml"
    network = ROOT / "examples" / "rslcpp_determinism"
    text = JOB.replace("NETWORK", str(network)).replace("2s", "1s")
    job.write_text(text + keys + "\n")
    with ThreadPoolExecutor(max_workers=2) as pool:
        around = map(quiet, range(RUNS_OF_A_POLICY))
        done = list(pool.map(lambda each: recorded(each, job, tmp_path), around))
    return {run.digest: run.path for run in done}


@pytest.mark.long
def test_one_digest_under_every_policy(tmp_path: Path) -> None:
    found = {}
    for name, keys in POLICIES.items():
        folder = tmp_path / name
        folder.mkdir()
        traces = digests(folder, keys)
        assert len(traces) == 1, (name, traces)
        found.update({name: next(iter(traces.items()))})
    assert len({digest for digest, _ in found.values()}) == len(POLICIES), "each is another order"
    folder = tmp_path / "recorded"
    folder.mkdir()
    digest, trace = found["permutation"]
    shutil.copy(trace, folder / "order.mcap")
    assert set(digests(folder, "policy: {recorded: order.mcap}")) == {digest}
