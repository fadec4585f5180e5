"""What RSLCPP has helper nodes for: a timeout, a bag's progress, code around the construction."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import pytest

import rsltrace
from rsltrace import BagSpec, Job, NodeSpec, StopSpec, Trace
from rsltrace.errors import JobError, NodeError
from rsltrace.job import HooksSpec
from rsltrace.trace.recordings import open_bag
from rsltrace.trace.recordings.export import export_bag

pytestmark = pytest.mark.ros

TALKER = "nodes: [{node: nodes_under_test:Talker}]\n"


@pytest.mark.long
def test_a_timeout_is_a_failure(record_job: Any) -> None:
    result = record_job(TALKER + "start: 10s\nstop: {timeout: 2.5s, topic: /never}\n")
    assert (result.exit_code, result.end_ns) == (1, 12 * 10**9)
    assert result.stop_reason == "timeout of 2.500000000 s"
    assert result.error is None
    in_time = record_job(TALKER + "stop: {timeout: 9s, duration: 2s}\n")
    assert (in_time.exit_code, in_time.stop_reason) == (0, "duration of 2.000000000 s")


def test_rslcpps_error_code_ends_a_run(record_job: Any) -> None:
    code = (
        "from std_msgs.msg import UInt8\n"
        "class Judge(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('judge')\n"
        "        p = self.create_publisher(UInt8, '/rslcpp/error_code', 1)\n"
        "        self.create_timer(2.0, lambda: p.publish(UInt8(data=42)))\n"
    )
    result = record_job(
        "nodes: [{node: nodes_under_test:Judge}]\n"
        "stop: {timeout: 60s, topic: {name: /rslcpp/error_code, exit_code: data}}\n",
        code,
    )
    assert (result.exit_code, result.end_ns) == (42, 2 * 10**9)


@pytest.mark.long
def test_what_a_node_makes_of_the_process_ends_with_the_run(
    record_job: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = (
        "import os, sys\n"
        "class Careless(Talker):\n"
        "    def __init__(self):\n"
        "        super().__init__()\n"
        "        os.chdir('/')\n"
        "        os.umask(0o077)\n"
        "        os.environ['LEFT'] = 'here'\n"
        "        del os.environ['KEPT']\n"
        "        sys.argv = ['another']\n"
    )

    def process() -> tuple[Any, ...]:
        mask = os.umask(0o022)
        os.umask(mask)
        return os.getcwd(), mask, dict(os.environ), list(sys.argv)

    monkeypatch.setenv("KEPT", "as it was")
    before, argv = process(), sys.argv
    node = "nodes: [{node: nodes_under_test:Careless}]\n"
    assert record_job(node + "stop: {duration: 2s}\n", code).error is None
    assert process() == before
    assert sys.argv is argv
    monkeypatch.setenv("KEPT", "again")
    code += "        raise ValueError\n"
    assert record_job(node + "stop: {duration: 2s}\n", code).error is not None
    assert process() == (*before[:2], {**before[2], "KEPT": "again"}, before[3])


# -- progress --------------------------------------------------------------------------------------


@pytest.fixture
def bag(record_job: Any, tmp_path: Path) -> Path:
    """Forty messages, one per second from 101 s on."""
    result = record_job(TALKER + "start: 100s\nstop: {duration: 40s}\n")
    export_bag(result.path, tmp_path / "bag", topics=["/numbers"])
    return tmp_path / "bag"


def progress(path: Path) -> list[tuple[int, float]]:
    with Trace.open(path) as trace:
        return [
            (stamp, round(trace.decode("/progress", data).data, 2))
            for stamp, _, data in trace.messages("/progress")
        ]


@pytest.mark.long
def test_progress_of_a_bag(bag: Path, tmp_path: Path) -> None:
    job = Job(bags=[BagSpec(path=bag)], progress="/progress")
    result = rsltrace.record(job, tmp_path / "played.mcap")
    assert result.stop_reason == "end of the bag"
    told = progress(tmp_path / "played.mcap")
    assert told[:3] == [(101 * 10**9, 0.0), (102 * 10**9, 0.02), (103 * 10**9, 0.05)]
    assert told[-1] == (140 * 10**9, 1.0)
    assert [value for _, value in told] == sorted({value for _, value in told})

    plain = rsltrace.record(job.replace(progress=None), tmp_path / "plain.mcap")
    assert plain.events == result.events - len(told)


@pytest.mark.long
def test_progress_of_bags_that_play_twice_or_slowly(bag: Path, tmp_path: Path) -> None:
    job = Job(
        bags=[BagSpec(path=bag, loop=2), BagSpec(path=bag, rate=0.5, start_offset="20s")],
        progress="/progress",
    )
    rsltrace.record(job, tmp_path / "played.mcap")
    told = progress(tmp_path / "played.mcap")
    assert told[0][1] == 0.0
    assert told[-1][1] == 1.0
    assert [stamp for stamp, _ in told] == sorted(stamp for stamp, _ in told)
    halfway = next(stamp for stamp, value in told if value >= 0.5)
    assert abs(halfway - (told[0][0] + told[-1][0]) // 2) <= 10**9


@pytest.mark.long
def test_a_node_may_watch_the_progress(bag: Path, tmp_path: Path) -> None:
    from rclpy.node import Node
    from std_msgs.msg import Float32

    seen: list[float] = []

    class Watcher(Node):
        def __init__(self) -> None:
            super().__init__("watcher")
            self.create_subscription(Float32, "/rslcpp/progress", self.got, 10)

        def got(self, message: Float32) -> None:
            seen.append(message.data)

    job = Job(nodes=[NodeSpec(node=Watcher)], bags=[BagSpec(path=bag)], progress="/rslcpp/progress")
    rsltrace.record(job, None)
    assert (seen[0], seen[-1]) == (0.0, 1.0)


@pytest.mark.long
def test_progress_that_cannot_be(bag: Path) -> None:
    with pytest.raises(JobError, match="there are no bags"):
        Job(nodes=[NodeSpec(node="a:b")], progress="/p")
    with pytest.raises(JobError, match="plays forever makes no progress"):
        Job(bags=[BagSpec(path=bag, loop=True)], progress="/p", stop=StopSpec(duration="1s"))
    with open_bag(bag) as opened:
        assert opened.end_ns == 140 * 10**9


# -- hooks -----------------------------------------------------------------------------------------

HOOKS = """
from rclpy.parameter import Parameter
calls = []

def prepare(job):
    calls.append(('before', job.seed))

def wire(nodes):
    calls.append(('after', [node.get_name() for node in nodes]))
    nodes[0].set_parameters([Parameter('use_sim_time', value=True)])
    return Listener()

def broken(nodes):
    raise ValueError('cannot wire')

def wrong(one, two):
    pass
"""


def test_hooks_around_the_construction(record_job: Any, tmp_path: Path) -> None:
    result = record_job(
        TALKER + "seed: 7\nstop: {duration: 3s}\n"
        "hooks: {before: nodes_under_test:prepare, after: nodes_under_test:wire}\n",
        HOOKS,
    )
    assert result.error is None
    with Trace.open(result.path) as trace:
        names = [e.name for e in trace.entities.values() if e.kind.label == "node"]
        kinds = [trace.event(i).kind.label for i in range(trace.event_count)]
    assert names == ["/talker", "/listener"]
    assert kinds[:3] == ["construct", "construct", "construct"]
    assert kinds.count("subscription") == 3  # the listener that the hook returned


@pytest.mark.long
def test_hooks_in_python_and_what_goes_wrong(record_job: Any) -> None:
    calls: list[str] = []
    job = Job(
        nodes=[NodeSpec(node="rclpy.node:Node", arguments={"node_name": "plain"})],
        hooks=HooksSpec(
            before=lambda job: calls.append("before"), after=lambda nodes: calls.append("after")
        ),
    )
    rsltrace.record(job, None)
    assert calls == ["before", "after"]
    result = record_job(TALKER + "hooks: {after: nodes_under_test:broken}\n", HOOKS)
    assert isinstance(result.error, NodeError)
    assert "hook after: nodes_under_test:broken" in str(result.error)
    assert "ValueError: cannot wire" in str(result.error)
    with pytest.raises(JobError, match=r"job\.yaml:2:16: .*has no 'brokn'; did you mean 'broken'"):
        record_job(TALKER + "hooks: {after: nodes_under_test:brokn}\n", HOOKS)
    for name in ("before", "after"):
        with pytest.raises(
            JobError, match=r"job\.yaml:2:1\d: .*wrong is called with the .*missing"
        ):
            record_job(TALKER + f"hooks: {{{name}: nodes_under_test:wrong}}\n", HOOKS)
