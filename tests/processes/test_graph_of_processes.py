"""Processes that wait for the graph to change, by rcl's guard conditions and by rclpy's polling."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

CHANGES = """
import rclpy
from rclpy.node import Node
from std_msgs.msg import UInt64
from std_srvs.srv import Empty

rclpy.init()
node = Node('changes')
made = []
steps = iter([
    lambda: made.append(node.create_publisher(UInt64, 'late', 1)),
    lambda: node.create_service(Empty, 'reset', lambda request, response: response),
    lambda: made.append(node.create_publisher(UInt64, 'late', 1)),
    lambda: node.destroy_publisher(made.pop()),
    lambda: node.destroy_publisher(made.pop()),
])
node.create_timer(0.1, lambda: next(steps, lambda: None)())
rclpy.spin(node)
"""
POLLS = """
import rclpy
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Empty

rclpy.init()
node = Node('polls')
said = node.create_publisher(String, 'said', 10)
client = node.create_client(Empty, 'reset')
while node.count_publishers('late') < 1:
    rclpy.spin_once(node, timeout_sec=0.02)
said.publish(String(data='publisher'))
said.publish(String(data=f'{client.wait_for_service(timeout_sec=5.0)}'))
"""
JOB = """
nodes:
{entries}
stop: {{duration: 1s}}
"""


def _said(folder: Path, topic: str, *entries: str) -> list[tuple[int, object]]:
    """Run a job twice, and return (stamp in ms, data) of a topic."""
    (folder / "changes.py").write_text(CHANGES)
    (folder / "polls.py").write_text(POLLS)
    text = JOB.format(entries="\n".join(f"  - {{{entry}}}" for entry in entries))
    (folder / "job.yaml").write_text(text)
    results = [run(load_job(folder / "job.yaml"), folder / f"{n}.mcap") for n in range(2)]
    assert [(result.error, result.exit_code) for result in results] == [(None, 0)] * 2
    assert results[0].digest == results[1].digest
    with Trace.open(folder / "0.mcap") as trace:
        return [
            (stamp // 10**6, trace.decode(topic, data).data)  # type: ignore[attr-defined]
            for stamp, _, data in trace.messages(topic)
        ]


def test_a_wait_on_the_graphs_guard_condition_is_over_when_the_graph_has_changed(
    compiled: Callable[[str], Path], tmp_path: Path
) -> None:
    program = compiled("graph_waiter.c")
    said = _said(tmp_path, "/found", f"program: {program}", "script: changes.py")
    assert said == [(100, 1), (300, 2), (400, 1), (500, 0), (600, 100)]


@pytest.mark.long
@pytest.mark.parametrize("isolated", ["true", "false"])
def test_a_process_that_polls_the_graph_sees_what_comes(
    compiled: object, tmp_path: Path, isolated: str
) -> None:
    changes = f"script: changes.py, isolated: {isolated}"
    said = _said(tmp_path, "/said", "script: polls.py, isolated: true", changes)
    assert [text for _, text in said] == ["publisher", "True"]
    (publisher, _), (service, _) = said
    assert 100 <= publisher <= 120
    assert 200 <= service <= publisher + 250  # rclpy looks every quarter of a second


def test_time_passes_for_who_asks_the_same_of_the_graph_again_and_again(tmp_path: Path) -> None:
    busy = POLLS.replace("rclpy.spin_once(node, timeout_sec=0.02)", "pass")
    (tmp_path / "busy.py").write_text(busy)
    said = _said(tmp_path, "/said", "script: changes.py", "script: busy.py, isolated: true")
    assert said[0][1] == "publisher"
    assert 100 <= said[0][0] <= 101
