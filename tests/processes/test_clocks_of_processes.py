"""Clocks that a job makes wrong are wrong in processes, too, and nothing but them."""

from __future__ import annotations

from pathlib import Path

import pytest

from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

NODE = """
import sys
import threading
import time

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import String


class Teller(Node):
    def __init__(self, name):
        super().__init__(name)
        self.out = self.create_publisher(String, f'{name}/shown', 10)
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(0.1, self.tick)
        self.say('begins')

    def say(self, *more):
        now = self.get_clock().now().nanoseconds
        again = self.get_clock().now().nanoseconds
        steady = self.steady.now().nanoseconds
        text = ' '.join(map(str, (now, again, steady, *more)))
        self.out.publish(String(data=text))

    def tick(self):
        self.say(time.time_ns())
        time.sleep(0.013)
        self.say(time.time_ns())
        threading.Event().wait(0.011)
        if 'sleeps' in sys.argv:  # it looks at its clock itself, which may advance by that
            clock = self.get_clock()
            clock.sleep_until(clock.now() + Duration(nanoseconds=10_000_000))
        self.say(time.time_ns())


def main():
    rclpy.init()
    rclpy.spin(Teller(sys.argv[1]))


main()
"""
JOB = """
nodes:
  - {{script: teller.py, arguments: [{name}{sleeps}]{isolated}}}
clocks: [{{node: /{name}, {clock}}}]
start: 100s
stop: {{duration: 1s}}
"""


def _shown(folder: Path, name: str, clock: str, isolated: str) -> tuple[list[object], list[int]]:
    """Return (stamp, text) of what a node says its clocks show, and what was drawn."""
    (folder / "teller.py").write_text(NODE)
    sleeps = "" if "advances" in clock else ", sleeps"
    text = JOB.format(name=name, clock=clock, isolated=isolated, sleeps=sleeps)
    (folder / "job.yaml").write_text(text)
    result = run(load_job(folder / "job.yaml"), folder / "t.mcap", force=True)
    assert result.error is None
    with Trace.open(folder / "t.mcap") as trace:
        topic = f"/{name}/shown"
        said: list[object] = [
            (stamp, trace.decode(topic, data).data)  # type: ignore[attr-defined]
            for stamp, _, data in trace.messages(topic)
        ]
        drawn = [
            output.hash
            for index in range(trace.event_count)
            for output in trace.outputs_of(index)
            if output.kind is OutputKind.DRAW
        ]
    return said, drawn


@pytest.mark.parametrize(
    "clock",
    [
        "offset: -20ms, drift: 50000ppm, jumps: [{at: 250ms, by: -1s}, {at: 600ms, by: 50ms}], "
        "random_jumps: {every: 100ms, most: 5ms}",
        "advances: true, offset: 1s",
    ],
)
def test_a_wrong_clock_shows_a_process_what_it_shows_a_node_here(
    compiled: object, tmp_path: Path, clock: str
) -> None:
    here = _shown(tmp_path, "teller", clock, "")
    assert here == _shown(tmp_path, "teller", clock, ", isolated: true")
    assert len(here[0]) == 29


@pytest.mark.parametrize(("instant", "ms"), [("false", [113, 124]), ("true", [100, 111])])
def test_a_sleep_takes_simulated_time_unless_the_job_says_that_it_takes_none(
    tmp_path: Path, instant: str, ms: list[int]
) -> None:
    """Waits with a timeout take their time anyhow."""
    (tmp_path / "teller.py").write_text(NODE)
    entry = f"script: teller.py, arguments: [a], isolated: true, instant_sleep: {instant}"
    (tmp_path / "job.yaml").write_text(f"nodes: [{{{entry}}}]\nstop: {{duration: 150ms}}\n")
    assert run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap").error is None
    with Trace.open(tmp_path / "t.mcap") as trace:
        stamps = [stamp // 1_000_000 for stamp, _, _ in trace.messages("/a/shown")]
    assert stamps == [0, 100, *ms]
