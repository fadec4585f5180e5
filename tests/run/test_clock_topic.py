"""``clocks: {source: topic}``: /clock drives ROS time where ``use_sim_time`` is on, as natively."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rsltrace
from rsltrace.trace.reader import Trace
from rsltrace.trace.recordings.export import export_bag

pytestmark = pytest.mark.ros

CODE = """
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

TIMES = [0.5 * step for step in range(1, 9)] + [9.0, 1.5, 2.0, 2.5, 3.0]

class Simulator(Node):
    '''Publishes /clock faster than real time, jumps ahead, and starts again.'''

    def __init__(self):
        super().__init__('simulator')
        self.publisher = self.create_publisher(Clock, '/clock', 10)
        self.times = iter(TIMES)
        self.create_timer(0.1, self.step)

    def step(self):
        time = next(self.times, None)
        if time is None:
            raise SystemExit
        shown = Time(nanoseconds=int(time * 1e9))
        self.publisher.publish(Clock(clock=shown.to_msg()))

class Robot(Node):
    def __init__(self):
        super().__init__('robot', parameter_overrides=[Parameter('use_sim_time', value=True)])
        self.say(f'begins at {self.now()}')
        self.create_timer(1.0, lambda: self.say(f'second at {self.now()}'))
        self.count = 0
        self.slow = self.create_timer(1.5, self.thrice)
        threshold = JumpThreshold(
            min_forward=Duration(seconds=3),
            min_backward=Duration(seconds=-1),
            on_clock_change=True,
        )
        self.jumps = self.get_clock().create_jump_callback(threshold, post_callback=self.jumped)

    def say(self, text):
        self.get_logger().info(text)

    def now(self):
        return self.get_clock().now().nanoseconds / 1e9

    def thrice(self):
        self.count += 1
        self.say(f'slow at {self.now()}')
        if self.count == 3:
            self.slow.cancel()

    def jumped(self, jump):
        self.say(f'jumped by {jump.delta.nanoseconds / 1e9}')

class Sleeper(Node):
    def __init__(self):
        super().__init__('sleeper', parameter_overrides=[Parameter('use_sim_time', value=True)])
        # in another group than the subscription of /clock, which has to go on meanwhile
        self.create_timer(0.5, self.doze, callback_group=ReentrantCallbackGroup())

    def doze(self):
        clock = self.get_clock()
        woken = clock.sleep_until(Time(seconds=3, clock_type=ClockType.ROS_TIME))
        self.get_logger().info(f'{woken} {clock.now().nanoseconds / 1e9}')

def main():
    rclpy.init()
    simulator, robot = Simulator(), Robot()
    executor = SingleThreadedExecutor()
    executor.add_node(simulator)
    executor.add_node(robot)
    try:
        executor.spin()
    except SystemExit:
        pass

if __name__ == '__main__':
    main()
"""


def logs(path: Path) -> list[str]:
    with Trace.open(path) as trace:
        return [
            trace.decode("/rosout", data).msg  # type: ignore[attr-defined]
            for _, _, data in trace.messages("/rosout")
        ]


JUST = [
    "begins at 0.0", "second at 1.0", "slow at 1.5", "second at 2.0", "second at 3.0",
    "slow at 3.0", "second at 4.0", "jumped by 5.0", "second at 9.0", "slow at 9.0",
    "jumped by -7.5", "second at 2.5",
]  # fmt: skip


@pytest.mark.long
def test_a_simulator_drives_the_time_of_others(record_job: Callable[..., Any]) -> None:
    nodes = "nodes: [{node: nodes_under_test:Simulator}, {node: nodes_under_test:Robot}]\n"
    yaml = f"{nodes}clocks: {{source: topic}}\nstop: {{duration: 1.35s}}\n"
    result = record_job(yaml, CODE)
    assert logs(result.path) == JUST
    assert record_job(yaml, CODE, output="again.mcap").digest == result.digest
    assert rsltrace.replay(result.path, trust=True).digest == result.digest
    assert rsltrace.replay(result.path, node="robot", trust=True).same
    # without it, and for other nodes, the run itself is the only source of time
    for more in ("", "clocks: [{node: /simulator, source: topic}]\n"):
        plain = record_job(f"{nodes}{more}stop: {{duration: 1.35s}}\n", CODE, output="plain.mcap")
        assert logs(plain.path) == ["begins at 0.0", "second at 1.0"]


def test_a_simulator_whose_time_nobody_follows_is_noted(record_job: Callable[..., Any]) -> None:
    nodes = "nodes: [{node: nodes_under_test:Simulator}, {node: nodes_under_test:Robot}]\n"
    for more, times in (("", 1), ("clocks: {source: topic}\n", 0), ("clocks: []\n", 1)):
        result = record_job(f"{nodes}{more}stop: {{duration: 500ms}}\n", CODE, output="noted.mcap")
        assert len([note for note in result.notes if "clocks: {source: topic}" in note]) == times
    result = record_job(nodes.replace("Robot", "Simulator, name: other"), CODE, output="two.mcap")
    assert not any("clocks" in note for note in result.notes)


def test_the_clock_of_a_bag_is_that_of_the_run(record_job: Callable[..., Any]) -> None:
    nodes = "nodes: [{node: nodes_under_test:Simulator}]\nstop: {duration: 500ms}\n"
    recorded = record_job(nodes, CODE)
    export_bag(recorded.path, recorded.path.parent / "bag")
    result = record_job(
        "nodes: [{node: nodes_under_test:Robot}]\nbags: [bag]\n", CODE, output="played.mcap"
    )
    assert not any("clocks" in note for note in result.notes)


def test_a_main_goes_by_it_too(record_job: Callable[..., Any]) -> None:
    result = record_job("nodes: [{main: nodes_under_test:main}]\nclocks: {source: topic}\n", CODE)
    assert logs(result.path) == JUST


def test_who_sleeps_until_a_ros_time_wakes_when_the_clock_shows_it(
    record_job: Callable[..., Any],
) -> None:
    nodes = "nodes: [{node: nodes_under_test:Simulator}, {node: nodes_under_test:Sleeper}]\n"
    result = record_job(f"{nodes}clocks: {{source: topic}}\nstop: {{duration: 0.75s}}\n", CODE)
    assert logs(result.path)[0] == "True 3.0"


@pytest.mark.long
@pytest.mark.usefixtures("own_domain")
def test_it_is_as_over_dds(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(CODE)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "program.py")],
        capture_output=True,
        text=True,
        timeout=600,
        check=True,
    )
    native = re.findall(r"\[INFO\] \[[\d.]+\] \[robot\]: (.*)", done.stderr)
    assert native == JUST
