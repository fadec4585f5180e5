"""What full queues drop is counted for each queue, told, kept in the trace and in no digest."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.cli.main import cli
from rsltrace.job import load_job
from rsltrace.run import RunResult, run
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.finding import QueueDrops, decode_drops
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

NODES = """
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import UInt64

class Source(Node):
    def __init__(self):
        super().__init__('source')
        self.out = self.create_publisher(UInt64, 'a', 5)
        self.create_timer(0.01, lambda: self.out.publish(UInt64(data=1)))

class Slow(Node):
    def __init__(self):
        super().__init__('slow')
        self.create_subscription(UInt64, 'a', lambda message: None, 2)

def polls():
    rclpy.init()
    node = Node('slow')
    node.create_subscription(UInt64, 'a', lambda message: None, 2)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while rclpy.ok():
        executor.spin_once(timeout_sec=0)
        node.get_clock().sleep_for(rclpy.duration.Duration(seconds=0.05))
"""
SLOW = "execution: {nodes: {/slow: 50ms}}\n"
JOB = """
search_path: [.]
nodes: [{node: queue_nodes:Source}, {WHO}]
stop: {duration: 1s}
"""


def _run(
    folder: Path, who: str, more: str
) -> tuple[RunResult, list[QueueDrops], dict[EventKind, int]]:
    (folder / "queue_nodes.py").write_text(NODES)
    (folder / "job.yaml").write_text(JOB.replace("WHO", who) + more)
    result = run(load_job(folder / "job.yaml"), folder / "t.mcap")
    assert result.error is None
    with Trace.open(folder / "t.mcap") as trace:
        kinds: dict[EventKind, int] = {}
        mine = {e.id for e in trace.entities.values() if e.name == "/a"}
        for index in range(trace.event_count):
            event = trace.event(index)
            if event.entity in mine:
                kinds[event.kind] = kinds.get(event.kind, 0) + 1
        return result, decode_drops(trace.result), kinds


@pytest.mark.parametrize(
    ("who", "more"),
    [
        ("node: queue_nodes:Slow", SLOW),
        ("node: queue_nodes:Slow", SLOW + "delay: {default: 1ms}\n"),
        ("main: queue_nodes:polls", ""),
    ],
    ids=["node", "links", "main"],
)
def test_a_slow_subscription_says_how_many_messages_its_queue_dropped(
    tmp_path: Path, who: str, more: str
) -> None:
    result, drops, kinds = _run(tmp_path, who, more)
    assert [(drop.depth, drop.in_outage) for drop in drops] == [(2, False)]
    sent, taken = 100, kinds[EventKind.SUBSCRIPTION]
    assert sent - taken - 3 <= drops[0].count <= sent - taken
    told = f"full queues dropped their oldest messages: /slow: subscription /a {drops[0].count} "
    assert [note for note in result.notes if "queues" in note] == [f"{told}(depth 2)"]
    shown = CliRunner().invoke(cli, ["info", str(tmp_path / "t.mcap")]).output
    assert "full queues\n" in shown
    assert f"{drops[0].count}      2  /slow  subscription  /a    its own" in shown
    listed = CliRunner().invoke(cli, ["info", "--json", str(tmp_path / "t.mcap")]).output
    assert json.loads(listed)["drops"][0]["count"] == drops[0].count


def test_nothing_is_said_of_queues_that_were_large_enough(tmp_path: Path) -> None:
    result, drops, _ = _run(tmp_path, "node: queue_nodes:Slow", "")
    assert drops == []
    assert not any("queues" in note for note in result.notes)
    assert "full queues" not in CliRunner().invoke(cli, ["info", str(tmp_path / "t.mcap")]).output


def test_what_a_publisher_cannot_keep_in_an_outage_is_counted_with_its_depth(
    tmp_path: Path,
) -> None:
    outage = "delay: {default: 0ms, outages: [{node: /slow, from: 200ms, to: 400ms}]}\n"
    _, drops, _ = _run(tmp_path, "node: queue_nodes:Slow", outage)
    assert QueueDrops(drops[0].entity, 5, 15, in_outage=True) in drops
