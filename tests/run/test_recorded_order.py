"""``policy: {recorded: …}``: the same job is followed to the last byte, whatever it is made of; of
another job it is said which event was the first that is not the recording's."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import JobError
from rsltrace.simulation.loop.policy import PolicyChoices, decode_choices
from rsltrace.trace.reader import Trace

MIXED = """
import threading, time
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from std_srvs.srv import Trigger

class Threaded(Node):
    def __init__(self, name):
        super().__init__(name)
        self.count = 0
        self.publisher = self.create_publisher(UInt64, 'numbers', 10)
        self.reset = self.create_client(Trigger, 'reset')
        for callback in (self.tick, self.tick, self.ask):
            self.create_timer(0.1, callback)

    def tick(self):
        threading.Thread(target=self.work).start()

    def work(self):
        self.publisher.publish(UInt64(data=self.count))
        time.sleep(0.05)
        self.count += 1
        self.publisher.publish(UInt64(data=self.count))

    async def ask(self):
        await self.reset.call_async(Trigger.Request())
        self.publisher.publish(UInt64(data=1000 + self.count))

class Blocking(Node):
    def __init__(self):
        super().__init__('blocking')
        self.reset = self.create_client(Trigger, 'reset')
        for _ in range(2):
            self.create_timer(0.1, self.tick, callback_group=ReentrantCallbackGroup())

    def tick(self):
        self.reset.call(Trigger.Request())
        self.get_logger().info('called')
        time.sleep(0.02)

class Server(Listener):
    def __init__(self):
        super().__init__()
        self.create_service(Trigger, 'reset', lambda request, response: response)

def main():
    rclpy.init()
    node = Node('in_main')
    log = node.get_logger().info
    node.create_timer(0.1, lambda: log('a'))
    node.create_timer(0.1, lambda: log('b'))
    node.create_subscription(UInt64, 'numbers', lambda message: log(str(message.data)), 10)
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    executor.spin()

class Turns:
    def choose(self, ready, moment):
        return moment.events * 7919 % len(ready)
"""

ALL = """\
nodes:
  - {node: nodes_under_test:Threaded, arguments: {name: one}}
  - {node: nodes_under_test:Threaded, arguments: {name: two}}
  - {node: nodes_under_test:Blocking}
  - {node: nodes_under_test:Server}
  - {main: nodes_under_test:main}
stop: {duration: 0.5s}
record: {segment_events: 8}
"""


@pytest.mark.long
@pytest.mark.parametrize(
    "policy",
    [
        "fifo",
        "permutation",
        "rate_monotonic",
        "{priority: [{node: /in_main, priority: 3}]}",
        "{function: nodes_under_test:Turns}",
    ],
)
def test_mains_threads_and_calls_that_block_are_followed_exactly(
    record_job: Callable[..., Any], tmp_path: Path, policy: str
) -> None:
    first = record_job(ALL + f"policy: {policy}\nseed: 5\n", MIXED)
    shutil.copy(first.path, tmp_path / "first.mcap")
    again = record_job(ALL + "policy: {recorded: first.mcap}\n", MIXED, output="again.mcap")
    assert (again.error, again.notes) == (None, ())
    assert (again.digest, again.events) == (first.digest, first.events)
    data = first.path.read_bytes()  # as a killed run leaves it: what was chosen is not in it
    name = b"rsltrace/segments" if policy == "fifo" else b"rsltrace/choices"
    (tmp_path / "first.mcap").write_bytes(data[: data.index(name) - 40])
    with Trace.open(tmp_path / "first.mcap") as trace:
        assert not trace.complete
        assert trace.attachment("rsltrace/choices") is None
        followed = trace.event_count
    third = record_job(ALL + "policy: {recorded: first.mcap}\n", MIXED, output="third.mcap")
    assert third.error is None
    with Trace.open(again.path) as one, Trace.open(third.path) as two:
        assert followed > 30
        assert all(one.event(index) == two.event(index) for index in range(followed))
    shutil.copy(again.path, tmp_path / "first.mcap")  # a recording of what was followed, too
    fourth = record_job(ALL + "policy: {recorded: first.mcap}\n", MIXED, output="fourth.mcap")
    assert fourth.digest == first.digest


def test_choices_as_a_trace_holds_them() -> None:
    choices = PolicyChoices()
    assert not choices
    numbers = [0, 1, 254, 255, 256, 70_000, 0]
    for number in numbers:
        choices.add(number)
    assert choices
    assert list(decode_choices(choices.encoded())) == numbers


PAIR = """\
nodes:
  - {node: nodes_under_test:Talker}
  - {node: nodes_under_test:Listener}
stop: {duration: 5s}
"""
FOLLOW = "policy: {recorded: first.mcap}\n"


@pytest.fixture
def followed(record_job: Callable[..., Any], tmp_path: Path) -> Callable[..., Any]:
    """Record ``PAIR`` with a policy, then a job that follows it."""

    def follow(yaml: str, code: str = "", *, policy: str = "permutation") -> Any:
        first = record_job(PAIR + f"policy: {policy}\n")
        shutil.copy(first.path, tmp_path / "first.mcap")
        return record_job(yaml + FOLLOW, code, output="second.mcap")

    return follow


@pytest.mark.long
@pytest.mark.parametrize("policy", ["fifo", "permutation"])
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "stop:",
            "  - {node: nodes_under_test:Listener, name: more}\nstop:",
            "its event 2 is /talker: timer Talker.tick at 1.000000000 s, but here it was "
            "constructing nodes_under_test:Listener at 0.000000000 s",
        ),
        (
            "Talker}",
            "Talker, remappings: {numbers: other}}",
            "its event 3 is /listener: subscription /numbers at 1.000000000 s, but here it was "
            "/talker: timer Talker.tick at 2.000000000 s",
        ),
        (
            "Listener}",
            "Listener, name: another}",
            "its event 3 is /listener: subscription /numbers at 1.000000000 s, but here it was "
            "/another: subscription /numbers at 1.000000000 s",
        ),
    ],
)
def test_the_first_event_that_is_another_ends_the_run(
    followed: Callable[..., Any], policy: str, old: str, new: str, message: str
) -> None:
    result = followed(PAIR.replace(old, new, 1), policy=policy)
    assert f"the recorded order of first.mcap cannot be followed: {message}" in str(result.error)
    assert result.exit_code == 3
    with Trace.open(result.path) as trace:
        assert trace.result["stop_reason"] == "the recorded order cannot be followed"


@pytest.mark.long
@pytest.mark.parametrize(
    ("old", "new", "notes"),
    [
        ("", "", []),
        ("duration: 5s", "duration: 2s", []),
        (
            "Talker}",
            "Talker, arguments: {period: 2.0}}",
            [
                "the run follows the order of first.mcap, but not its times: event 2 is /talker: "
                "timer Talker.tick at 1.000000000 s there, and at 2.000000000 s here",
                "the run ended before first.mcap did: its event 6, /talker: timer Talker.tick at "
                "3.000000000 s, has not come",
            ],
        ),
        (
            "duration: 5s",
            "duration: 6s",
            [
                "first.mcap ends with its event 11 (/listener: subscription /numbers at "
                "5.000000000 s); from there on this run was first come, first served"
            ],
        ),
    ],
)
def test_what_else_is_not_as_recorded_is_noted(
    followed: Callable[..., Any], old: str, new: str, notes: list[str]
) -> None:
    result = followed(PAIR.replace(old, new))
    assert result.error is None
    assert list(result.notes) == notes


def test_a_publisher_more_does_not_matter(followed: Callable[..., Any]) -> None:
    """Entities are the same if their names are, although all ids differ."""
    code = """
class Verbose(Talker):
    def __init__(self):
        super().__init__()
        self.debug = self.create_publisher(String, 'debug', 10)
        self.create_timer(1.0, self.tick)
        self.destroy_timer(list(self.timers)[0])
"""
    result = followed(PAIR.replace("Talker}", "Verbose}"), code)
    assert (result.error, result.notes) == (None, ())


@pytest.mark.long
def test_a_recording_that_was_cut_off(record_job: Callable[..., Any], tmp_path: Path) -> None:
    keys = "policy: permutation\nrecord: {segment_events: 5}\n"
    first = record_job(PAIR + keys)
    data = first.path.read_bytes()
    with Trace.open(first.path) as trace:
        starts = [int(start) for start in trace.segments["events_offset"]]
    cut = tmp_path / "first.mcap"
    cut.write_bytes(data[: starts[1]])
    result = record_job(PAIR + FOLLOW, output="second.mcap")
    assert result.error is None
    assert list(result.notes) == [
        "first.mcap was cut off after its event 4 (/talker: timer Talker.tick at 2.000000000 s); "
        "from there on this run was first come, first served"
    ]
    cut.write_bytes(data[: starts[0]])
    with pytest.raises(
        JobError, match=r"job.yaml:5:20: first.mcap has no events to follow: it was"
    ):
        record_job(PAIR + FOLLOW, output="third.mcap")
