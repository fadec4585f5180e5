"""Loops that look at a rate of their own (``spin_some``) get all that they get natively."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.job import load_job
from rsltrace.run import RunResult, run
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

SOURCE = """
from rclpy.node import Node
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger

class Source(Node):
    def __init__(self):
        super().__init__('source')
        self.topics = [self.create_publisher(UInt64, f't{i}', 10) for i in range(4)]
        self.ask = self.create_client(Trigger, 'ask')
        self.answers = self.create_publisher(UInt64, 'answers', 10)
        self.create_timer(0.02, self.tick)
        self.count = 0

    def tick(self):
        self.count += 1
        for topic in self.topics:
            topic.publish(UInt64(data=self.count))
        if self.count % 10 == 0:
            self.ask.call_async(Trigger.Request()).add_done_callback(
                lambda future: self.answers.publish(UInt64(data=self.count)))
"""
CLOCK = """
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

class Times(Node):
    def __init__(self):
        super().__init__('times')
        self.out = self.create_publisher(Clock, '/clock', 10)
        self.create_timer(0.05, self.tick)

    def tick(self):
        now = self.get_clock().now().nanoseconds * 2
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now, 10**9)
        self.out.publish(message)
"""


def _run(folder: Path, program: Path, mode: str, more: str = "", name: str = "t") -> RunResult:
    (folder / "source_node.py").write_text(SOURCE)
    text = f"""
search_path: [.]
nodes:
  - {{node: source_node:Source}}
  - {{program: {program}, arguments: [{mode}]}}
stop: {{duration: 1s}}
{more}"""
    (folder / "job.yaml").write_text(text)
    result = run(load_job(folder / "job.yaml"), folder / f"{name}.mcap")
    assert result.error is None
    return result


def _seen(path: Path, topic: str = "/seen") -> list[int]:
    with Trace.open(path) as trace:
        return [trace.decode(topic, data).data for _, _, data in trace.messages(topic)]  # type: ignore[attr-defined]


@pytest.mark.few(1)
@pytest.mark.parametrize("mode", ["plain", "guard", "ask"])
def test_a_loop_that_looks_at_a_rate_gets_one_message_of_each_topic_each_time(
    compiled: Callable[[str], Path], tmp_path: Path, mode: str
) -> None:
    results = [_run(tmp_path, compiled("poller.c"), mode, name=str(n)) for n in range(2)]
    assert len({result.digest for result in results}) == 1
    seen = _seen(tmp_path / "0.mcap")
    counts = Counter(number // 100 for number in seen)
    assert {topic: counts[topic] for topic in range(4)} == dict.fromkeys(range(4), 50)
    assert counts[10] >= 48  # its timer
    assert counts[20] == len(_seen(tmp_path / "0.mcap", "/answers")) == 5


def test_all_that_one_look_finds_has_an_event_of_its_own_with_its_input(
    compiled: Callable[[str], Path], tmp_path: Path
) -> None:
    _run(tmp_path, compiled("poller.c"), "plain")
    callbacks = (EventKind.SUBSCRIPTION, EventKind.TIMER, EventKind.SERVICE)
    kinds: Counter[EventKind] = Counter()
    with Trace.open(tmp_path / "t.mcap") as trace:
        mine = {e.id for e in trace.entities.values() if e.name == "/poller"}
        for index in range(trace.event_count):
            event = trace.event(index)
            if trace.entities[event.entity].node not in mine:
                continue
            kinds[event.kind] += 1
            said = [one for one in trace.outputs_of(index) if one.kind is OutputKind.MESSAGE]
            assert len(said) == (event.kind in callbacks)
            if event.kind is EventKind.SUBSCRIPTION:
                assert trace.event(event.cause_event).kind is EventKind.TIMER
    assert kinds[EventKind.SUBSCRIPTION] == 4 * 50


def test_what_a_look_finds_runs_one_after_the_other_if_callbacks_take_time(
    compiled: Callable[[str], Path], tmp_path: Path
) -> None:
    more = "policy: permutation\nexecution: {nodes: {/poller: 1ms}}\n"
    _run(tmp_path, compiled("poller.c"), "plain", more)
    with Trace.open(tmp_path / "t.mcap") as trace:
        stamps = [stamp for stamp, _, _ in trace.messages("/seen")]
    assert len(stamps) > 150
    assert len(stamps) == len(set(stamps))


def test_who_looks_and_takes_nothing_lets_time_pass(
    compiled: Callable[[str], Path], tmp_path: Path
) -> None:
    _run(tmp_path, compiled("poller.c"), "leave")
    assert len(_seen(tmp_path / "t.mcap")) > 100


def test_a_timer_that_a_clock_thread_drives_is_called_where_nothing_else_is_waited_for(
    compiled: Callable[[str], Path], tmp_path: Path
) -> None:
    (tmp_path / "times_node.py").write_text(CLOCK)
    (tmp_path / "job.yaml").write_text(f"""
search_path: [.]
nodes:
  - {{node: times_node:Times}}
  - {{program: {compiled("driven_timer.c")}}}
clocks: [{{node: /driven, source: topic}}]
stop: {{duration: 1s}}
""")
    result = run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap")
    assert result.error is None
    assert _seen(tmp_path / "t.mcap", "/ticks") == [1, 2, 3, 4, 5]
