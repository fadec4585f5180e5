"""After a change of one line the node alone shows what a whole run shows of it first.

The changes are made by a tool (``mutations.py``). Until a node's first changed output nobody else
can have noticed, so both must agree on it: time, topic and content. A change of which the whole run
shows nothing must show nothing here.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

import rsltrace
from rsltrace.errors import RsltraceError
from rsltrace.job import load_job
from rsltrace.replay.one_node.output_comparison import outputs_of_node
from rsltrace.run import run
from rsltrace.trace.reader import Trace
from tests.replay.conftest import JOB, NODES
from tests.replay.mutations import Mutation, mutations
from tests.run.conftest import TALKER
from tests.run.test_recorded_order import ALL, MIXED

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[2]

Seen = tuple[int, str, str, int]


@pytest.fixture(autouse=True)
def no_bytecode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sources change faster than their times do: Python would take them for unchanged."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)


def sent_by(trace: Path, node: str) -> list[Seen]:
    """Return (time, kind, topic, hash) of a node's outputs, in order."""
    with Trace.open(trace) as opened:
        return [
            (put.stamp_ns, put.output.kind.label, put.key[1], put.output.hash)
            for put in outputs_of_node(opened, node)
        ]


def first_difference(a: list[Seen], b: list[Seen]) -> int | None:
    """Return at which place two sequences of outputs differ first, None if they do not."""
    if a == b:
        return None
    pairs = enumerate(zip(a, b, strict=False))
    return next((place for place, (x, y) in pairs if x != y), min(len(a), len(b)))


class Campaign:
    """Changes to the ``module`` of a job that concern ``nodes``; ``root`` says it is only theirs,
    so that what others do differently follows from what they do."""

    def __init__(self, job: Path, module: Path, nodes: Sequence[str], *, root: bool) -> None:
        self.job, self.module, self.nodes, self._root = job, module, nodes, root
        self.source = module.read_text()
        self.trace = job.with_name("run.mcap")
        run(load_job(job), self.trace, force=True)
        self._recorded = {node: sent_by(self.trace, node) for node in nodes}
        self.compared = self.changed = 0

    def check(self, mutation: Mutation) -> None:
        """Run the whole job with the changed code, then each node alone, and compare."""
        self.module.write_text(mutation.source)
        whole = self.job.with_name("whole.mcap")
        try:
            path = run(load_job(self.job), whole, force=True).path
        except RsltraceError:
            return  # what is no code any more
        assert path is not None
        there = {node: sent_by(path, node) for node in self.nodes}
        found = {node: first_difference(self._recorded[node], there[node]) for node in self.nodes}
        times = {node: self._time(node, place, there[node]) for node, place in found.items()}
        for node, place in found.items():
            others = min((t for n, t in times.items() if n != node), default=1 << 64)
            if self._root or times[node] < others or min(times.values()) == 1 << 64:
                self._compare(node, place, times[node], there[node], mutation.what)

    def _time(self, node: str, place: int | None, there: list[Seen]) -> int:
        if place is None:
            return 1 << 64
        sides = (self._recorded[node], there)
        return min(side[place][0] for side in sides if place < len(side))

    def _compare(
        self, node: str, place: int | None, time_ns: int, there: list[Seen], what: str
    ) -> None:
        alone = self.job.with_name("alone.mcap")
        result = rsltrace.replay(
            self.trace, node=node, trust=True, job_folder=self.job.parent, output=alone, force=True
        )
        assert result.path is not None
        here = sent_by(result.path, node)
        where = f"{node}, {what}: {result.sentence}"
        self.compared += 1
        assert first_difference(self._recorded[node], here) == place, where
        if place is None:
            assert result.same, where
            return
        self.changed += 1
        assert result.first is not None, where
        assert result.first.time_ns == time_ns, where
        assert here[: place + 1] == there[: place + 1], where


def fusion(folder: Path, module: str, node: str) -> Campaign:
    """Return a campaign with the sensor fusion example, two seconds of it."""
    source = ROOT / "examples/sensor_fusion"
    shutil.copytree(source, folder / "job", ignore=shutil.ignore_patterns("__pycache__"))
    job = folder / "job/job.yaml"
    head, stop, _ = job.read_text().partition("\nstop:")
    job.write_text(f"{head}{stop} {{duration: 2s}}\n")
    return Campaign(job, folder / "job/fusion_demo" / module, [node], root=True)


@pytest.mark.long
def test_of_a_pipeline(tmp_path: Path) -> None:
    (tmp_path / "nodes_of_replay.py").write_text(NODES)
    (tmp_path / "job.yaml").write_text(JOB.replace("3s", "1s"))
    for node in ("source", "filter", "watch"):
        module = tmp_path / "nodes_of_replay.py"
        module.write_text(NODES)
        campaign = Campaign(tmp_path / "job.yaml", module, [f"/{node}"], root=True)
        before, _, after = NODES.partition(f"class {node.capitalize()}")
        first = before.count("\n")
        last = first + after.partition("\nclass ")[0].count("\n")
        for mutation in mutations(NODES):
            if first < mutation.line <= last + 1:
                campaign.check(mutation)
        assert campaign.changed > 1, node


@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.long), 27])
def test_of_mains_threads_and_services(every: int, tmp_path: Path) -> None:
    (tmp_path / "nodes_under_test.py").write_text(TALKER + MIXED)
    (tmp_path / "job.yaml").write_text(ALL + "seed: 5\n")
    nodes = ["/one", "/two", "/blocking", "/listener", "/in_main"]
    module = tmp_path / "nodes_under_test.py"
    campaign = Campaign(tmp_path / "job.yaml", module, nodes, root=False)
    for mutation in [*mutations(campaign.source)][::every]:
        campaign.check(mutation)
    assert campaign.changed > 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("module", "node", "every"),
    [
        pytest.param("ekf.py", "/ekf", 1, marks=pytest.mark.long),
        pytest.param("ekf_node.py", "/ekf", 1, marks=pytest.mark.long),
        pytest.param("planner.py", "/planner", 1, marks=pytest.mark.long),
        pytest.param("follower.py", "/follower", 1, marks=pytest.mark.long),
        pytest.param("track_monitor.py", "/track_monitor", 1, marks=pytest.mark.long),
        pytest.param("robot.py", "/robot", 1, marks=pytest.mark.long),
        ("ekf.py", "/ekf", 30),
        ("follower.py", "/follower", 3),
    ],
)
def test_of_the_fusion_example(module: str, node: str, every: int, tmp_path: Path) -> None:
    campaign = fusion(tmp_path, module, node)
    for mutation in [*mutations(campaign.source)][::every]:
        campaign.check(mutation)
    assert campaign.changed > 0
