"""``rsltrace check``: what a job means and who talks to whom, without a callback being run."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.job import load_job
from rsltrace.run.checking import check_job

NODES = """
from test_msgs.action import Fibonacci
from rclpy.action import ActionClient, ActionServer
from rclpy.qos import qos_profile_sensor_data
from std_srvs.srv import Trigger

class Sensor(Node):
    def __init__(self):
        super().__init__('sensor')
        self.publisher = self.create_publisher(UInt64, 'raw', qos_profile_sensor_data)
        self.create_timer(0.1, self.tick)

    def tick(self):
        raise AssertionError('no callback runs')

class Filter(Node):
    def __init__(self):
        super().__init__('filter')
        self.create_subscription(UInt64, 'raw', print, 10)
        self.create_subscription(UInt64, 'nothing', print, 10)
        self.out = self.create_publisher(UInt64, 'smooth', 10)
        self.client = self.create_client(Trigger, 'reset')
        self.action = ActionServer(self, Fibonacci, 'count', print)

class Caller(Node):
    def __init__(self):
        super().__init__('caller')
        self.action = ActionClient(self, Fibonacci, 'count')
        self.create_subscription(UInt64, 'smooth', print, 10)

class Broken(Node):
    def __init__(self):
        super().__init__('broken')
        raise ValueError('not today')
"""

JOB = """
nodes:
  - node: nodes_under_test:Sensor
  - node: nodes_under_test:Filter
  - node: nodes_under_test:Caller
stop: {duration: 5s}
"""

FINE = "nodes: [{node: nodes_under_test:Talker}, {node: nodes_under_test:Listener}]\n"

EXPECTED = """\
job:
  nodes:
    - node: nodes_under_test:Sensor
    - node: nodes_under_test:Filter
    - node: nodes_under_test:Caller
  stop:
    duration: 2s

starts at simulated time 0.000000000 s

nodes:
  /sensor  nodes_under_test:Sensor
    timer Sensor.tick every 100 ms
  /filter  nodes_under_test:Filter
  /caller  nodes_under_test:Caller

topics:
  /nothing  std_msgs/msg/UInt64  (none)   ->  /filter
  /raw      std_msgs/msg/UInt64  /sensor  ->  /filter
  /smooth   std_msgs/msg/UInt64  /filter  ->  /caller

services:
  /reset  std_srvs/srv/Trigger  /filter  ->  (none)

actions:
  /count  test_msgs/action/Fibonacci  /caller  ->  /filter

to look at:
  service /reset: /filter calls, but it has no server
  topic /nothing: /filter subscribes, but it has no publisher
  topic /raw: /sensor and /filter do not connect: reliability \
(/sensor offers best effort, volatile, keep last 5; \
/filter asks for reliable, volatile, keep last 10)
"""


def test_a_listener_of_transforms_needs_nobody_who_publishes_static_ones(
    command: Any, job_file: Callable[..., Path]
) -> None:
    code = """
from std_msgs.msg import Empty as TFMessage

class Listens(Node):
    def __init__(self):
        super().__init__('listens')
        for topic in ('/tf', '/tf_static'):
            self.create_subscription(TFMessage, topic, print, 10)

class Moves(Node):
    def __init__(self):
        super().__init__('moves')
        self.create_publisher(TFMessage, '/tf', 10)
"""
    alone = "nodes: [{node: nodes_under_test:Listens}]\nstop: {duration: 1s}\n"
    job_file(alone, code)
    done = command("check", "job.yaml")
    assert "topic /tf: /listens subscribes, but it has no publisher" in done.stdout
    assert "topic /tf_static: /listens subscribes, but it has no publisher" in done.stdout
    job_file(alone.replace("}]", "}, {node: nodes_under_test:Moves}]", 1), code)
    done = command("check", "job.yaml")
    assert (done.returncode, "no problems found" in done.stdout) == (0, True)


def test_the_report_of_a_job(command: Any, job_file: Callable[..., Path], tmp_path: Path) -> None:
    job_file(JOB, NODES)
    done = command("check", "job.yaml", "--set", "stop.duration=2s", "--graph", "g.svg")
    assert done.stderr == ""
    assert done.stdout == EXPECTED
    assert done.returncode == 1
    picture = (tmp_path / "g.svg").read_text("utf-8")
    texts = [e.text for e in ET.fromstring(picture).iter() if e.tag.endswith("}text")]
    assert sorted(filter(None, texts)) == [
        "/caller", "/count", "/filter", "/nothing", "/raw", "/reset", "/sensor", "/smooth"
    ]  # fmt: skip
    assert picture.count('class="edge apart"') == 2  # both halves of /raw
    assert {path.name for path in tmp_path.iterdir()} >= {"job.yaml", "g.svg"}
    assert not list(tmp_path.glob("*.mcap"))


def test_a_job_in_which_nothing_is_wrong(command: Any, job_file: Callable[..., Path]) -> None:
    job_file(FINE)
    done = command("check", "job.yaml", "--format", "json")
    assert done.returncode == 0
    values = json.loads(done.stdout)
    assert values["job"]["livelock_limit"] == 100_000
    assert values["graph"]["problems"] == []
    (link,) = values["graph"]["links"]
    assert (link["name"], link["senders"][0]["node"]) == ("/numbers", "/talker")


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("clocks", "problems"),
    [
        ("[]", ()),
        (
            "[{node: /talker, source: topic}]",
            (
                "topic /clock: /talker uses it (clocks: source: topic), but it has no publisher: "
                "ROS time stands still at 0",
            ),
        ),
        (
            "{source: topic}",
            (
                "topic /clock: /talker and /listener use it (clocks: source: topic), but it has no "
                "publisher: ROS time stands still at 0",
            ),
        ),
    ],
)
def test_clock_matters_where_it_sets_the_time(
    clocks: str, problems: tuple[str, ...], job_file: Callable[..., Path]
) -> None:
    simulated = "ros_arguments: [-p, 'use_sim_time:=true']"
    path = job_file(f"{FINE}clocks: {clocks}\n{simulated}\n")
    assert check_job(load_job(path)).problems == problems


MAIN = """
import rclpy

def main():
    rclpy.init()
    rclpy.spin(Talker())
"""


def test_a_main_that_spins_waits_for_nothing(command: Any, job_file: Callable[..., Path]) -> None:
    job_file("nodes: [{main: nodes_under_test:main}, {node: nodes_under_test:Listener}]\n", MAIN)
    done = command("check", "job.yaml")
    assert done.stdout.endswith("  ->  /listener\n\nno problems found\n")
    assert done.stderr == "next: rsltrace record job.yaml\n"


@pytest.mark.long
def test_a_topic_that_is_played_and_published(command: Any, job_file: Callable[..., Path]) -> None:
    job_file(FINE)
    done = command("record", "job.yaml", "--set", "stop.duration=3s", "--export-bag", "numbers")
    assert done.returncode == 0, done.stderr
    job_file(FINE + "bags: [numbers]\n")
    done = command("check", "job.yaml")
    assert done.returncode == 1
    assert done.stdout.endswith(
        "to look at:\n"
        "  topic /numbers: both a bag and /talker publish it; "
        "if that is not intended: bags: [{path: ..., exclude: [/numbers]}]\n"
    )
    job_file(FINE + "bags: [{path: numbers, exclude: [/numbers]}]\n")
    assert command("check", "job.yaml").returncode == 0


@pytest.mark.parametrize(
    ("job", "expected"),
    [
        (FINE.replace("Listener", "Broken"), "ValueError: not today"),
        (FINE + "sede: 1\n", "job.yaml:2:1: unknown key 'sede'; did you mean 'seed'?"),
        (FINE.replace("Listener", "Lisener"), "did you mean 'Listener'?"),
    ],
)
def test_a_job_that_cannot_run(
    command: Any, job_file: Callable[..., Path], job: str, expected: str
) -> None:
    job_file(job, NODES)
    done = command("check", "job.yaml")
    assert done.returncode == 2
    assert expected in done.stderr
    assert done.stdout == ""


def test_only_svg_is_drawn(command: Any, job_file: Callable[..., Path]) -> None:
    job_file(FINE)
    done = command("check", "job.yaml", "--graph", "graph.png")
    assert done.returncode == 2
    assert "graph.png should end in .svg" in done.stderr


def test_a_graph_without_connections_is_drawn_too(job_file: Callable[..., Path]) -> None:
    from rsltrace.cli.output.graph_svg import graph_svg

    code = "class Alone(Node):\n    def __init__(self):\n        super().__init__('alone')\n"
    overview = check_job(
        load_job(job_file("nodes: [{node: nodes_under_test:Alone}]", code))
    ).overview
    texts = [e.text for e in ET.fromstring(graph_svg(overview)).iter() if e.tag.endswith("}text")]
    assert texts == ["/alone"]


def test_everything_includes_what_each_node_has(job_file: Callable[..., Path]) -> None:
    job = load_job(job_file(FINE))
    few = {link.name for link in check_job(job).overview.links}
    many = {link.name for link in check_job(job, everything=True).overview.links}
    assert few == {"/numbers"}
    assert {"/numbers", "/rosout", "/talker/get_parameters"} <= many


def test_a_constructor_that_waits_is_named(job_file: Callable[..., Path]) -> None:
    code = """
class Waits(Node):
    def __init__(self):
        super().__init__('waits')
        self.get_clock().sleep_for(rclpy.duration.Duration(seconds=1))
"""
    job = load_job(job_file("nodes: [{node: nodes_under_test:Waits}]\n", "import rclpy\n" + code))
    (waiting,) = check_job(job).overview.waiting
    assert waiting.startswith("constructing nodes_under_test:Waits waits for a time to come")


@pytest.mark.long
def test_the_picture_of_a_graph_is_the_same_every_time(job_file: Callable[..., Path]) -> None:
    pytest.importorskip("fast_sugiyama")
    from rsltrace.cli.output.graph_svg import graph_svg

    job = load_job(job_file(JOB, NODES))
    pictures = {graph_svg(check_job(job).overview) for _ in range(3)}
    assert len(pictures) == 1


def test_what_keeps_ends_apart_is_shown_with_its_values(
    command: Any, job_file: Callable[..., Path]
) -> None:
    code = """
from rclpy.duration import Duration
from rclpy.qos import LivelinessPolicy, QoSProfile

class Slow(Node):
    def __init__(self):
        super().__init__('slow')
        qos = QoSProfile(depth=1, deadline=Duration(seconds=2), lifespan=Duration(seconds=1))
        self.create_publisher(UInt64, 'slow', qos)

class Picky(Node):
    def __init__(self):
        super().__init__('picky')
        qos = QoSProfile(depth=1, deadline=Duration(seconds=1))
        qos.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
        qos.liveliness_lease_duration = Duration(seconds=0.5)
        self.create_subscription(UInt64, 'slow', print, qos)
"""
    job_file("nodes: [{node: nodes_under_test:Slow}, {node: nodes_under_test:Picky}]\n", code)
    done = command("check", "job.yaml")
    assert done.returncode == 1
    assert done.stdout.endswith(
        "do not connect: liveliness and deadline (/slow offers reliable, volatile, keep last 1, "
        "deadline 2 s, lifespan 1 s; /picky asks for reliable, volatile, keep last 1, "
        "liveliness manual by topic, deadline 1 s, lease 500 ms)\n"
    )


def test_an_arrow_back_has_one_head_and_a_way_of_its_own() -> None:
    pytest.importorskip("fast_sugiyama")
    from rsltrace.cli.output.graph_svg import graph_svg
    from rsltrace.simulation.middleware.overview import (
        GraphEnd,
        GraphLink,
        GraphNode,
        GraphOverview,
    )

    nodes = tuple(GraphNode(name, "", ()) for name in ("/plan", "/drive"))
    plan, drive = GraphEnd("/plan"), GraphEnd("/drive")
    links = (
        GraphLink("topic", "/cmd", "", (plan,), (drive,)),
        GraphLink("topic", "/odom", "", (drive,), (plan,)),
        GraphLink("topic", "/own", "", (plan,), (plan,)),
    )
    parts = [e.attrib for e in ET.fromstring(graph_svg(GraphOverview(nodes, links))).iter()]
    paths = [part for part in parts if "d" in part]
    arrows = [path for path in paths if path.get("class", "").startswith("edge")]
    assert len(arrows) == 6
    assert all("marker-end" in arrow and "marker-start" not in arrow for arrow in arrows)
    back = [arrow for arrow in arrows if "back" in arrow["class"]]
    assert len(back) == 2  # one closes the loop of two nodes, one that of a node with itself
    boxes = [
        {name: float(part[name]) for name in ("x", "y", "width", "height")}
        for part in parts
        if "rx" in part
    ]
    assert len(boxes) == 5
    bottom = max(box["y"] + box["height"] for box in boxes)
    lowest = set()
    for arrow in back:  # it comes from the left, as others do, and passes no box
        numbers = [float(number) for number in re.findall(r"-?[\d.]+", arrow["d"])]
        points = [*zip(numbers[::2], numbers[1::2], strict=True)]
        assert points[-2][0] < points[-1][0]
        assert points[-2][1] == points[-1][1]
        lowest.add(max(y for _, y in points))
        for x, _ in points[1:-1]:
            assert not any(box["x"] <= x <= box["x"] + box["width"] for box in boxes)
    assert min(lowest) > bottom
    assert len(lowest) == 2, "one would be taken for the other"
