"""Execution times of nodes that spin on executors of their own: those have the workers."""

from __future__ import annotations

from typing import Any

import pytest

from rsltrace import Trace

pytestmark = pytest.mark.ros

CODE = """
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor

class Slow(Node):
    def __init__(self, group=None):
        super().__init__('slow')
        self.create_subscription(UInt64, 'numbers', self.got, 10, callback_group=group)

    def got(self, message):
        now_ms = self.get_clock().now().nanoseconds // 1_000_000
        self.get_logger().info(f'{message.data} at {now_ms}')

def single():
    rclpy.init()
    rclpy.spin(Slow())

def multi():
    rclpy.init()
    executor = MultiThreadedExecutor(2)
    executor.add_node(Slow(ReentrantCallbackGroup()))
    executor.spin()
"""
JOB = """
nodes:
  - {node: "nodes_under_test:Talker", arguments: {period: 0.1}}
  - {main: "nodes_under_test:MAIN"}
stop: {duration: 0.62s}
execution: {nodes: {/slow: 150ms}}
"""


@pytest.mark.parametrize(
    ("main", "starts"),
    [("single", [100, 250, 400, 550]), ("multi", [100, 200, 300, 400, 500, 600])],
)
def test_a_callback_keeps_the_thread_that_spins(
    record_job: Any, main: str, starts: list[int]
) -> None:
    result = record_job(JOB.replace("MAIN", main), CODE)
    assert result.error is None
    with Trace.open(result.path) as trace:
        logs = [trace.decode("/rosout", data).msg for _, _, data in trace.messages("/rosout")]
    heard = [text.split(" at ") for text in logs if " at " in text]
    assert [(int(number), int(at)) for number, at in heard] == list(enumerate(starts, start=1))


@pytest.mark.long
def test_an_executor_that_nobody_shuts_down_leaves_quietly(rsltrace: Any, job_file: Any) -> None:
    """It is collected when rclpy is the real one again, which knows nothing of it."""
    code = """
def careless():
    rclpy.init()
    global executor  # so that it lives as long as the process
    executor = MultiThreadedExecutor(2)
    executor.add_node(Slow())
    try:
        executor.spin()
    except KeyboardInterrupt:
        pass
"""
    job_file(JOB.replace("MAIN", "careless"), CODE + code)
    for command in (("record", "job.yaml", "-o", "run.mcap"), ("check", "job.yaml")):
        done = rsltrace(*command)
        assert done.returncode == 0, done.stderr
        assert "Exception ignored" not in done.stderr, done.stderr
