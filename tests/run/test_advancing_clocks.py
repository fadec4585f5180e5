"""``clocks: {advances: true}``: ROS clocks that advance by a nanosecond per look."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

import rsltrace
from rsltrace.errors import JobError
from rsltrace.job import load_job
from rsltrace.run.checking import check_job
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

CODE = """
from rclpy.clock import Clock, ClockType

class Looker(Node):
    def __init__(self, name='looker', period=1.0):
        super().__init__(name)
        self.publisher = self.create_publisher(Int32, 'ahead', 10)
        self.create_timer(1.0, self.look)
        self.create_timer(period, lambda: None)

    def look(self):
        start = self.get_clock().now()
        for _ in range(20):
            ahead = (self.get_clock().now() - start).nanoseconds
            self.publisher.publish(Int32(data=ahead))

class Sleeper(Node):
    def __init__(self):
        super().__init__('sleeper')
        self.create_timer(1.0, self.doze)

    def doze(self):
        clock = self.get_clock()
        for _ in range(3):
            until = clock.now() + rclpy.duration.Duration(seconds=0.1)
            clock.sleep_until(until)
            self.get_logger().info(str((clock.now() - until).nanoseconds))

class Divides(Node):
    def __init__(self):
        super().__init__('divides')
        self.create_timer(1.0, self.tick)

    def tick(self):
        start = self.get_clock().now()
        took = self.get_clock().now() - start
        self.get_logger().info(f'rate {1e9 / took.nanoseconds}')
"""
IMPORTS = "import rclpy\nimport rclpy.duration\n"


def ahead(path: Path, topic: str = "/ahead") -> list[int]:
    with Trace.open(path) as trace:
        return [
            trace.decode(topic, data).data  # type: ignore[attr-defined]
            for _, _, data in trace.messages(topic)
        ]


def yaml(node: str, clocks: str = "", until: str = "1s") -> str:
    return f"nodes: [{{{node}}}]\nstop: {{duration: {until}}}\n{clocks}"


LOOKER = "node: nodes_under_test:Looker"


@pytest.mark.long
def test_each_look_shows_a_nanosecond_more(record_job: Callable[..., Any]) -> None:
    code = IMPORTS + CODE
    assert ahead(record_job(yaml(LOOKER), code).path) == [0] * 20
    result = record_job(yaml(LOOKER, "clocks: {advances: true}"), code, output="a.mcap")
    assert ahead(result.path) == list(range(1, 21))
    assert rsltrace.replay(result.path, trust=True).digest == result.digest
    assert rsltrace.replay(result.path, node="looker", trust=True).same
    other = record_job(yaml(LOOKER, "clocks: [{node: /x, advances: true}]"), code, output="b.mcap")
    assert ahead(other.path) == [0] * 20


def test_never_past_the_next_event(record_job: Callable[..., Any]) -> None:
    """Another timer is due 8 ns later: the clock stops at 7."""
    node = f"{LOOKER}, arguments: {{period: 1.000000008}}"
    result = record_job(yaml(node, "clocks: {advances: true}"), IMPORTS + CODE)
    shown = ahead(result.path)
    assert shown == [*range(1, 8), *[7] * 13]
    assert all(b >= a for a, b in pairwise(shown))


def test_who_sleeps_until_a_time_wakes_at_it(record_job: Callable[..., Any]) -> None:
    node = "node: nodes_under_test:Sleeper"
    result = record_job(yaml(node, "clocks: {advances: true}", "2s"), IMPORTS + CODE)
    assert result.error is None
    with Trace.open(result.path) as trace:
        late = [
            int(trace.decode("/rosout", data).msg)  # type: ignore[attr-defined]
            for _, _, data in trace.messages("/rosout")
        ]
    assert len(late) == 3
    assert all(0 <= ns <= 3 for ns in late)


def test_a_division_by_nothing_names_the_option(record_job: Callable[..., Any]) -> None:
    node = "node: nodes_under_test:Divides"
    failed = record_job(yaml(node), IMPORTS + CODE)
    assert failed.exit_code == 3
    assert "clocks: {advances: true}" in str(failed.error)
    assert record_job(yaml(node, "clocks: {advances: true}"), IMPORTS + CODE).error is None


def test_check_points_at_it(job_file: Callable[..., Path]) -> None:
    node = "node: nodes_under_test:Divides"
    (note,) = check_job(load_job(job_file(yaml(node), IMPORTS + CODE))).notes
    assert note.startswith("nodes_under_test.py:")
    assert "division by took.nanoseconds, which is 0: ROS clocks stand still in a callback" in note
    path = job_file(yaml(node, "clocks: {advances: true}"), IMPORTS + CODE)
    assert check_job(load_job(path)).notes == ()


def test_clocks_are_a_list_or_one_for_all(job_file: Callable[..., Path]) -> None:
    assert load_job(job_file(yaml(LOOKER, "clocks: {advances: true}"))).clocks[0].node == "*"
    with pytest.raises(JobError, match=r"job\.yaml:3:9: .*expected a list of clocks, or what is"):
        load_job(job_file(yaml(LOOKER, "clocks: fast")))
