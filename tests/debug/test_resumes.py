"""Callbacks that wait: what follows is an event of its own, at which a run stops like at others."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace_viewer.live.execution import Executed, LiveSession
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.events import node_of

from rsltrace import DebugSession
from rsltrace.debug.checkpoints import StopReport
from rsltrace.job import load_job
from rsltrace.run import record
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

NODES = """
import time
import rclpy
from rclpy.node import Node
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

class Server(Node):
    def __init__(self):
        super().__init__('server')
        self.create_service(Trigger, 'work', self.work)

    def work(self, request, response):
        time.sleep(0.03)
        response.success = True
        return response

class Sleeper(Node):
    def __init__(self):
        super().__init__('sleeper')
        self.stage = 0
        self.out = self.create_publisher(Float64, 'stage', 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.stage += 1
        time.sleep(0.02)
        self.stage += 1
        self.out.publish(Float64(data=float(self.stage)))

class Asker(Node):
    def __init__(self):
        super().__init__('asker')
        group = ReentrantCallbackGroup()
        self.answers = 0
        self.client = self.create_client(Trigger, 'work', callback_group=group)
        self.create_subscription(Float64, 'stage', self.ask, 10, callback_group=group)

    async def ask(self, message):
        answer = await self.client.call_async(Trigger.Request())
        self.answers += answer.success

def main():
    rclpy.init()
    node = Node('manager')
    client = node.create_client(Trigger, 'work')
    while rclpy.ok():
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(node, future)
        node.get_logger().info('answered')
        end = time.monotonic() + 0.15
        while time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.04)
"""
JOB = """\
nodes:
  - node: waiting_nodes:Server
  - node: waiting_nodes:Sleeper
  - node: waiting_nodes:Asker
  - main: waiting_nodes:main
stop: {duration: 0.25s}
guard: {state: true}
"""
LINES = ("", *NODES.splitlines())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job whose callbacks and main wait, and its trace."""
    made = tmp_path_factory.mktemp("waiting")
    (made / "waiting_nodes.py").write_text(NODES)
    (made / "job.yaml").write_text(JOB)
    record(load_job(made / "job.yaml"), made / "run.mcap")
    return made


def events_of(trace: Trace, name: str) -> list[int]:
    """Return the events of a node or entity that begin or go on, its construction left out."""
    found = []
    for index in range(trace.event_count):
        event = trace.event(index)
        entity = trace.entities.get(event.entity)
        owner = trace.entities.get(entity.node) if entity is not None else None
        names = {one.name for one in (entity, owner) if one is not None}
        if name in names and event.kind is not EventKind.CONSTRUCT:
            found.append(index)
    return found


def stops(session: DebugSession) -> list[StopReport]:
    """Run to the end; return where breakpoints have stopped on the way."""
    found = []
    while (stopped := session.go_on()).reason == "breakpoint":
        found.append(stopped)
    assert stopped.reason == "end"
    return found


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "at",
    [
        "node /sleeper",
        "node /asker",
        "node /manager",
        "entity waiting_nodes:main",
        pytest.param("node /server", marks=pytest.mark.long),
    ],
)
def test_a_node_stops_where_it_goes_on_forwards_and_back(
    session: DebugSession, trace: Trace, at: str
) -> None:
    session.break_at(at)
    wanted = events_of(trace, at.split()[1])
    goes_on = any(trace.event(index).kind is EventKind.RESUME for index in wanted)
    assert goes_on == (at != "node /manager"), "what its main does is no event of the node"
    found = stops(session)
    assert [stop.position.index for stop in found] == wanted
    assert all(stop.position.is_next for stop in found)
    for stop, index in zip(found, wanted, strict=True):
        assert stop.position.stamp_ns == trace.event(index).stamp_ns
        assert stop.position.next is not None
        assert stop.position.next["kind"] == trace.event(index).kind.label
    for stop in reversed(found):
        assert session.reverse_go_on().position == stop.position
    assert session.reverse_go_on().reason == "begin"


def test_times_stop_before_what_goes_on(session: DebugSession, trace: Trace) -> None:
    stamps = [trace.event(index).stamp_ns for index in range(trace.event_count)]
    seen = []
    for stamp in sorted(set(stamps))[:-1]:
        position = session.run_to(f"{stamp}ns").position
        assert (position.index, position.is_next) == (sum(one <= stamp for one in stamps), True)
        assert position.stamp_ns == stamps[position.index]
        seen.append(position)
    session.go_to(0)
    session.step()
    for position in seen[:-1]:
        assert session.finish().position == position
        assert session.step().position.index == position.index + 1


def test_where_a_callback_waits_and_goes_on(session: DebugSession) -> None:
    def line() -> str:
        source = session.inspect("source")
        assert source["lines"] == list(LINES[source["line"] :][: len(source["lines"])])
        return "" if source["at"] is None else LINES[source["at"]].strip()

    session.break_at("node /sleeper")
    session.go_on()
    assert line() == ""
    session.step()
    assert line() == "time.sleep(0.02)"
    assert session.evaluate("stage", "sleeper") == 1
    session.go_on()
    assert session.position.is_next
    assert line() == "time.sleep(0.02)"
    session.step()
    assert line() == ""
    assert session.evaluate("stage", "sleeper") == 2
    session.break_at("node /asker")
    waits = []
    for _ in range(3):
        session.go_on()
        waits.append((session.position.next or {}).get("kind"))
        source = session.inspect("source")
        if waits[-1] != "client":
            assert source["name"].endswith("ask")
            assert session.inspect("message")["content"] == {"data": 2.0}
    assert waits == ["subscription", "client", "resume"]
    assert line() == "answer = await self.client.call_async(Trigger.Request())"
    session.break_at("entity waiting_nodes:main")
    while (session.position.next or {}).get("entity") != "waiting_nodes:main":
        session.go_on()
    assert line() == "rclpy.spin_once(node, timeout_sec=0.04)"
    assert session.inspect("message") is None


def test_a_message_is_received_once(session: DebugSession, trace: Trace) -> None:
    session.break_at("topic /stage")
    received = [stop.position.index for stop in stops(session) if stop.position.is_next]
    assert received == [
        index
        for index in events_of(trace, "/asker")
        if trace.event(index).kind is EventKind.SUBSCRIPTION
    ]


def test_what_the_viewer_says_of_those_that_go_on(folder: Path) -> None:
    """A main that has run a callback on its own stack goes on because of it, with nothing of it."""
    run = Run.open(folder / "run.mcap")
    events = [run.event(index) for index in range(run.count)]
    inputs = [run.input_of(one) for one in events if one.kind is EventKind.RESUME]
    assert {None if one is None else one.kind for one in inputs} == {None, OutputKind.TASK}
    shown = LiveSession(run)
    shown.place = next(one.index for one in events if node_of(run, one) == "(run)")
    shown.executed = Executed(shown.place, "(run)", {}, {}, None)
    lines = [f"{line.label} {line.value}" for line in shown.lines()]
    assert lines
    assert not any("state of" in line or "parameters" in line for line in lines), lines
    run.close()


@pytest.mark.long
def test_a_main_of_a_job_that_nobody_has_recorded(folder: Path, trace: Trace) -> None:
    """Whether one that spins does something is known only when it has; then it is known."""
    wanted = events_of(trace, "waiting_nodes:main")
    with DebugSession(folder / "job.yaml") as session:
        session.break_at("entity waiting_nodes:main")
        first = [stop.position for stop in stops(session)]
        assert [one.index - (not one.is_next) for one in first] == wanted
        session.go_to(0)
        again = [stop.position for stop in stops(session)]
        assert [one.index for one in again] == wanted
        assert all(one.is_next for one in again)


THREADS = """
import threading
import time
import rclpy

class Own(threading.Thread):
    def run(self):
        time.sleep(0.2)

def work(seconds):
    time.sleep(seconds)

def main():
    rclpy.init()
    node = rclpy.create_node('talker')
    threading.Thread(target=work, args=(0.1,), daemon=True).start()
    Own(daemon=True).start()
    rclpy.spin(node)
"""


def test_a_thread_about_to_begin_has_a_source(tmp_path: Path) -> None:
    (tmp_path / "threads.py").write_text(THREADS)
    (tmp_path / "job.yaml").write_text("nodes: [{main: threads:main}]\nstop: {duration: 1s}\n")
    trace = record(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap").path
    with DebugSession(trace, trust=True) as session:
        session.break_at("node /talker")
        names = []
        for _ in range(2):
            session.go_on()
            assert session.position.is_next
            names.append(session.inspect("source")["name"].rpartition(".")[2])
    assert names == ["work", "run"]
