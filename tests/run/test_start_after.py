"""``start_after:``: entries that start while the run goes on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rsltrace
from rsltrace.errors import JobError
from rsltrace.job import load_job
from rsltrace.run.checking import check_job
from rsltrace.trace.model.event import NO_EVENT, EventKind
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

NODES = """
import rclpy
from std_msgs.msg import String
from std_srvs.srv import Trigger

def said(name):
    def make():
        node = Node(name)
        node.get_logger().info(f'{name} is here')
        return node
    return make

one, two = said('one'), said('two')

def fails():
    raise RuntimeError('no hardware')

class Server(Node):
    def __init__(self):
        super().__init__('server')
        self.create_service(Trigger, 'go', self.go)
        publisher = self.create_publisher(String, 'map', 10)
        self.create_timer(1.0, lambda: publisher.publish(String(data='m')))

    def go(self, request, response):
        response.success = True
        return response

def client():
    rclpy.init()
    node = Node('client')
    client = node.create_client(Trigger, 'go')
    while not client.wait_for_service(timeout_sec=0.5):
        node.get_logger().info('service not available, waiting again...')
    future = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, future)
    node.get_logger().info(f'answered {future.result().success}')
    node.destroy_node()
    rclpy.shutdown()

def last():
    rclpy.init()
    node = Node('last')
    node.get_logger().info('last is here')
    rclpy.spin_once(node, timeout_sec=1.0)
"""

ALL = """
nodes:
  - {node: "nodes_under_test:Server", start_after: 1.7s}
  - {main: "nodes_under_test:client"}
  - {main: "nodes_under_test:last", start_after: {ended: "nodes_under_test:client", delay: 1s}}
  - {node: "nodes_under_test:one", start_after: {topic: /map, node: /last}}
  - {node: "nodes_under_test:two", start_after: {service: /go, started: 3, delay: 250ms}}
stop: {duration: 6s}
"""


def logs(path: Path) -> list[tuple[int, str]]:
    """Return (milliseconds, text) of each log record."""
    with Trace.open(path) as trace:
        return [
            (time_ns // 1_000_000, trace.decode("/rosout", data).msg)  # type: ignore[attr-defined]
            for time_ns, _, data in trace.messages("/rosout")
        ]


def nodes(*entries: str, more: str = "") -> str:
    return "nodes:\n" + "".join(f"  - {{{entry}}}\n" for entry in entries) + more


@pytest.mark.few(1)
@pytest.mark.parametrize("more", ["", "policy: permutation\n", "executors: single_threaded\n"])
def test_entries_start_when_their_job_says(
    more: str, record_job: Callable[..., Any], tmp_path: Path
) -> None:
    """A client that comes too early says so, as over DDS; the order of starts is in the trace."""
    result = record_job(ALL + more, NODES)
    assert result.error is None
    assert logs(result.path) == [
        (500, "service not available, waiting again..."),
        (1000, "service not available, waiting again..."),
        (1500, "service not available, waiting again..."),
        (1750, "answered True"),
        (2750, "last is here"),
        (2750, "one is here"),
        (3000, "two is here"),
    ]
    with Trace.open(result.path) as trace:
        events = [trace.event(index) for index in range(trace.event_count)]
        made = [event for event in events if event.kind is EventKind.CONSTRUCT]
        assert [event.cause_event for event in made[:2]] == [NO_EVENT, NO_EVENT]
        causes = [events[event.cause_event] for event in made[2:]]
        assert [cause.kind.label for cause in causes] == ["resume", "construct", "construct"]
    whole = rsltrace.replay(result.path, trust=True)
    assert (whole.exit_code, whole.digest) == (0, result.digest)
    for node in () if more else ("server", "client", "last", "one", "two"):
        assert rsltrace.replay(result.path, node=node, trust=True).same


def test_a_start_that_fails_names_its_line(record_job: Callable[..., Any], tmp_path: Path) -> None:
    yaml = nodes(
        'node: "nodes_under_test:one"',
        'node: "nodes_under_test:fails", name: a, start_after: 1s',
        'node: "nodes_under_test:fails", name: b, start_after: 2s',
    )
    result = record_job(yaml, NODES)
    assert result.exit_code == 3
    assert "no hardware" in str(result.error)
    assert f"the job names it at {tmp_path / 'job.yaml'}:3:5" in str(result.error)
    assert result.end_ns == 1_000_000_000


def test_mains_that_start_when_all_others_have_ended(record_job: Callable[..., Any]) -> None:
    """The run goes on as long as somebody is to come, and says who never came."""
    result = record_job(
        nodes(
            'main: "nodes_under_test:last"',
            'main: "nodes_under_test:last", name: second, start_after: {ended: 0, delay: 1s}',
            'node: "nodes_under_test:one", start_after: {ended: second, topic: /nothing}',
        ),
        NODES,
    )
    assert logs(result.path) == [(0, "last is here"), (2000, "last is here")]
    assert result.stop_reason == "nothing left to do"
    (note,) = [note for note in result.notes if "not started" in note]
    assert "job.yaml:4:" in note
    assert "nodes_under_test:one has not started: it waited for topic /nothing" in note


@pytest.mark.parametrize(
    ("entry", "wrong"),
    [
        ("start_after: {}", "give one of delay, topic, service, node, started, ended"),
        (
            "start_after: {ended: clint}",
            "no entry of nodes is called 'clint': did you mean 'client'",
        ),
        ("start_after: {ended: 7}", "there are 3 entries, counted from 0: there is no 7"),
        ("start_after: {ended: -1}", "counted from 0, got -1"),
        ("start_after: {ended: server}", "never ends: a 'node' lasts as long as the run"),
        ("start_after: {started: itself}", "it waits for itself, and never starts"),
        ("start_after: {topic: map}", "write '/map'"),
        ("start_after: soon", "expected a time"),
        ("start_after: {after: 1s}", "unknown key"),
    ],
)
def test_starts_that_cannot_be_are_refused(
    entry: str, wrong: str, job_file: Callable[..., Path]
) -> None:
    yaml = nodes(
        'node: "nodes_under_test:Server", name: server',
        'main: "nodes_under_test:client", name: client',
        f'node: "nodes_under_test:one", name: itself, {entry}',
    )
    with pytest.raises(JobError) as raised:
        load_job(job_file(yaml, NODES))
    assert "job.yaml:4:" in str(raised.value)
    assert wrong in str(raised.value)


def test_circles_of_starts_and_names_of_several(job_file: Callable[..., Path]) -> None:
    yaml = nodes(
        'main: "nodes_under_test:client", start_after: {ended: b}',
        'main: "nodes_under_test:last", name: b, start_after: {started: c}',
        'main: "nodes_under_test:last", name: c, start_after: {ended: 0}',
        'node: "nodes_under_test:one", start_after: {ended: "nodes_under_test:last"}',
    )
    with pytest.raises(JobError) as raised:
        load_job(job_file(yaml, NODES))
    assert "nodes[0] → nodes[1] → nodes[2] → nodes[0]" in str(raised.value)
    assert "several entries are called 'nodes_under_test:last'" in str(raised.value)


def test_check_names_what_will_never_come(job_file: Callable[..., Path]) -> None:
    yaml = nodes(
        'node: "nodes_under_test:Server"',
        'node: "nodes_under_test:one", start_after: {topic: /maps}',
        'node: "nodes_under_test:two", start_after: {service: /went, node: /sever}',
        'main: "nodes_under_test:last", start_after: {topic: /map, delay: 11s}',
        more="stop: {duration: 10s}\n",
    )
    checked = check_job(load_job(job_file(yaml, NODES)))
    assert {node.name for node in checked.overview.nodes} == {"/server", "/one", "/two", "/last"}
    said = [problem.split(": ", 1) for problem in checked.problems]
    assert [(place.rsplit(":", 2)[1], text) for place, text in said] == [
        ("3", "nodes_under_test:one never starts: /maps has no publisher; did you mean '/map'?"),
        ("4", "nodes_under_test:two never starts: /went has no server"),
        ("4", "nodes_under_test:two never starts: no entry makes a node /sever; did you mean "
         "'/server'?"),
        ("5", "nodes_under_test:last never starts: that is 11 s after the start, and the run ends "
         "10 s after it"),
    ]  # fmt: skip
