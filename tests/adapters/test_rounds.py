"""``policy: rclpy`` against rclpy's own executor: the same callbacks in the same order."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from rsltrace import NodeSpec
from rsltrace.adapters.rclpy.concurrency.coroutines import _run_oldest_first
from rsltrace.simulation.loop.policy import Candidate, ChoicePoint
from rsltrace.simulation.loop.wait_set import RclpyWaitSetPolicy
from tests.adapters.rounds_program import Busy, Shared, nodes_of

pytestmark = pytest.mark.ros

PROGRAM = Path(__file__).with_name("rounds_program.py")
GOLDEN = Path(__file__).with_name("golden") / "rounds.txt"
"""What the program prints over DDS, with the wheels of Jazzy."""
SEEDS = (0, 1, 2, 8)
of_jazzy = pytest.mark.skipif(_run_oldest_first(), reason="the order is that of Jazzy")


def golden() -> dict[int, list[str]]:
    return orders(GOLDEN.read_text())


def orders(text: str) -> dict[int, list[str]]:
    lines = [line.split("; ") for line in text.splitlines() if line[:1].isdigit()]
    return {int(seed): order for seed, *order in lines}


@of_jazzy
def test_an_executor_of_the_users_own_keeps_rclpys_order(simulate: Any, capfd: Any) -> None:
    program = NodeSpec(script=PROGRAM, arguments=[str(seed) for seed in SEEDS])
    simulate(program, job={"policy": "rclpy"})
    assert orders(capfd.readouterr().out) == golden()


def run_nodes(simulate: Any, seed: int, policy: Any) -> tuple[list[str], Any]:
    """Run a system as nodes of the job, on one executor."""
    shared = Shared(seed)

    def nodes() -> list[Busy]:
        made = nodes_of(shared, seed)
        made[0].once("begin")
        return made

    done = simulate(nodes, duration=20, job={"policy": policy, "executors": "single_threaded"})
    return shared.log, done


@pytest.mark.long
@of_jazzy
def test_nodes_of_a_job_keep_rclpys_order(simulate: Any) -> None:
    for seed in SEEDS:
        assert run_nodes(simulate, seed, "rclpy")[0] == golden()[seed]


@pytest.mark.long
@pytest.mark.parametrize("policy", ["rclpy", {"order": "rclpy", "after": "20ms"}])
def test_that_order_can_be_replayed(simulate: Any, tmp_path: Path, policy: Any) -> None:
    """Also the replay of a replay, and of a main with an executor of its own."""
    main = NodeSpec(script=PROGRAM, arguments=["1"])
    for nodes in (None, main):

        def record(policy: Any, into: str, nodes: Any = nodes) -> Any:
            if nodes is None:
                done = run_nodes(simulate, 1, policy)[1]
            else:
                done = simulate(nodes, job={"policy": policy})
            done.path.rename(tmp_path / into)
            return done.result.digest

        digest = record(policy, "first.mcap")
        assert record({"recorded": "first.mcap"}, "second.mcap") == digest
        assert record({"recorded": "second.mcap"}, "third.mcap") == digest
        assert record("fifo", "other.mcap") != digest


@pytest.mark.native
@pytest.mark.usefixtures("own_domain")
def test_rclpy_itself_has_that_order(simulate: Any, capfd: Any) -> None:
    seeds = [str(seed) for seed in range(30)]
    command = [sys.executable, str(PROGRAM), *seeds]
    natively = subprocess.run(command, capture_output=True, text=True, check=True, timeout=1800)
    simulate(NodeSpec(script=PROGRAM, arguments=seeds), job={"policy": "rclpy"})
    assert orders(capfd.readouterr().out) == orders(natively.stdout)
    if not _run_oldest_first():
        assert golden().items() <= orders(natively.stdout).items()


class Task:
    def __init__(self, *, oldest_first: bool) -> None:
        self.oldest_first = oldest_first


@pytest.mark.parametrize(
    ("oldest_first", "expected"), [(False, [3, 2, 1, 5, 4]), (True, [1, 2, 3, 4, 5])]
)
def test_tasks_run_as_the_release_has_it(oldest_first: bool, expected: list[int]) -> None:
    """Tasks 4 and 5 are made while the second of the first three runs."""
    policy = RclpyWaitSetPolicy()
    left, ran = [1, 2, 3], []
    while left:
        item = Task(oldest_first=oldest_first)
        ready = [Candidate("/n", "", "task", 7, None, (), item, thread=one) for one in left]
        ran.append(left.pop(policy.choose(ready, ChoicePoint(0, 0))))
        if len(ran) == 2:
            left += [4, 5]
    assert ran == expected
