"""Entities that both runs made with other properties are named, whoever shows it first: the node,
the policy and both values, whichever run is a."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

import rsltrace
from rsltrace.diff.result import Diff

pytestmark = pytest.mark.ros

NODES = """
import os
import time
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy,
)
from std_msgs.msg import UInt64

def qos(end):
    text = os.environ.get(end, "")  # what no trace tells: a hidden input
    return QoSProfile(depth=5, **eval(f"dict({text})"))

class Source(Node):
    def __init__(self):
        super().__init__("source")
        self.count = 0
        self.out = self.create_publisher(UInt64, "/signal", qos("OFFERED"))
        self.timer = self.create_timer(float(os.environ.get("PERIOD", "0.1")), self.tick)

    def tick(self):
        self.count += 1
        self.out.publish(UInt64(data=self.count))

class Sink(Node):
    def __init__(self):
        super().__init__("sink")
        self.out = self.create_publisher(UInt64, "/heard", 5)
        self.create_subscription(UInt64, "/signal", self.heard, qos("REQUESTED"))

    def heard(self, message):
        self.out.publish(message)

def main():
    rclpy.init()
    order = [Sink, Source] if os.environ.get("FIRST") == "sink" else [Source, Sink]
    executor = rclpy.executors.SingleThreadedExecutor()
    for node in [make() for make in order]:
        executor.add_node(node)
    executor.spin()

class Guarded(Node):
    def __init__(self):
        super().__init__("guarded")
        self.watchdog = self.create_timer(float(os.environ.get("PERIOD", "0.5")), self.expired)
        self.create_timer(0.2, self.work)

    def work(self):
        self.watchdog.reset()

    def expired(self):
        pass

class Busy(Node):
    def __init__(self):
        super().__init__("busy")
        self.out = self.create_publisher(UInt64, "/done", 5)
        free = self.declare_parameter("free", False).value or os.environ.get("KIND") == "free"
        self.group = ReentrantCallbackGroup() if free else MutuallyExclusiveCallbackGroup()
        group = {"own": self.group, "free": ReentrantCallbackGroup()}.get(os.environ.get("GROUP"))
        self.create_timer(0.1, self.work, callback_group=self.group)
        self.create_timer(0.1, self.more, callback_group=group)

    def work(self):
        time.sleep(0.03)
        self.out.publish(UInt64(data=1))

    def more(self):
        self.out.publish(UInt64(data=2))
"""
JOB = """
nodes:
  - node: changed_nodes:Source
  - node: changed_nodes:Sink
stop: {duration: 1s}
guard: {environment: allow}
"""
BUSY = """
nodes:
  - node: changed_nodes:Busy
executors: [{nodes: [/busy], workers: 2}]
stop: {duration: 1s}
guard: {environment: allow}
"""


def recorded(
    folder: Path, name: str, monkeypatch: pytest.MonkeyPatch, job: str = JOB, **values: str
) -> Path:
    from rsltrace.run import run

    (folder / "changed_nodes.py").write_text(NODES)
    (folder / "job.yaml").write_text(job)
    with monkeypatch.context() as patch:
        for key, value in values.items():
            patch.setenv(key, value)
        run(rsltrace.load_job(folder / "job.yaml"), folder / name, force=True)
    return folder / name


QOS = [
    ("OFFERED", "reliability=ReliabilityPolicy.BEST_EFFORT", "reliability reliable → best_effort"),
    ("OFFERED", "liveliness=LivelinessPolicy.MANUAL_BY_TOPIC", ""),
    (
        "REQUESTED",
        "durability=DurabilityPolicy.TRANSIENT_LOCAL",
        "durability volatile → transient_local",
    ),
    ("REQUESTED", "deadline=Duration(seconds=0.05)", "deadline none → 50 ms"),
    (
        "REQUESTED",
        "liveliness=LivelinessPolicy.MANUAL_BY_TOPIC",
        "liveliness automatic → manual_by_topic",
    ),
    ("REQUESTED", "liveliness_lease_duration=Duration(seconds=0.2)", "lease none → 200 ms"),
]


@pytest.mark.few(2)
@pytest.mark.parametrize(("end", "changed", "told"), QOS)
def test_qos_that_fits_no_more(
    end: str, changed: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    a = recorded(tmp_path, "a.mcap", monkeypatch)
    b = recorded(tmp_path, "b.mcap", monkeypatch, **{end: changed})
    diff, back = rsltrace.diff(a, b), rsltrace.diff(b, a)
    if not told:
        assert diff.identical
        return
    who = (
        "/source created publisher /signal"
        if end == "OFFERED"
        else "/sink created subscription /signal"
    )
    name, old, _, *new = told.split(" ")
    backwards = f"{name} {' '.join(new)} → {old}"
    peer = "the subscription of /sink" if end == "OFFERED" else "the publisher of /source"
    for found, values, run in ((diff, told, "b"), (back, backwards, "a")):
        unmatched = f", which in {run} does not match {peer}"
        assert f"{who} with a different QoS: {values}{unmatched}" in found.sentence
        assert_blames(found, who.split()[0])


def assert_blames(diff: Diff, node: str) -> None:
    other = "/sink" if node == "/source" else "/source"
    for said in (diff.sentence, diff.divergences[0].root_sentence):
        assert f"{other} is not deterministic" not in said
        assert f"the constructor of {other}" not in said


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("end", "requested", "offered", "told"),
    [
        (
            "OFFERED",
            "reliability=ReliabilityPolicy.RELIABLE",
            "reliability=ReliabilityPolicy.BEST_EFFORT",
            "reliability reliable → best_effort",
        ),
        (
            "OFFERED",
            "durability=DurabilityPolicy.TRANSIENT_LOCAL",
            "durability=DurabilityPolicy.VOLATILE",
            "durability transient_local → volatile",
        ),
        (
            "OFFERED",
            "deadline=Duration(seconds=0.2)",
            "deadline=Duration(seconds=0.5)",
            "deadline 200 → 500 ms",
        ),
        (
            "OFFERED",
            "liveliness_lease_duration=Duration(seconds=0.2)",
            "liveliness_lease_duration=Duration(seconds=0.2000001)",
            "lease 200 → 200.0001 ms",
        ),
    ],
)
def test_qos_that_is_offered_no_more(
    end: str,
    requested: str,
    offered: str,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    same = {"OFFERED": requested, "REQUESTED": requested}
    a = recorded(tmp_path, "a.mcap", monkeypatch, **same)
    b = recorded(tmp_path, "b.mcap", monkeypatch, **{**same, end: offered})
    diff = rsltrace.diff(a, b)
    assert f"/source created publisher /signal with a different QoS: {told}" in diff.sentence
    assert_blames(diff, "/source")


def test_what_the_other_node_read_is_the_likely_cause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = JOB.replace("guard: {environment: allow}\n", "")
    a = recorded(tmp_path, "a.mcap", monkeypatch, job)
    changed = QOS[0][1]
    b = recorded(tmp_path, "b.mcap", monkeypatch, job, OFFERED=changed)
    assert "/source read OFFERED" in rsltrace.diff(a, b).sentence


def test_what_an_event_of_one_run_read_itself_is_not_why_it_happened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = JOB.replace("guard: {environment: allow}\n", "")
    a = recorded(tmp_path, "a.mcap", monkeypatch, job)
    b = recorded(
        tmp_path, "b.mcap", monkeypatch, job.replace("  - node: changed_nodes:Source\n", "")
    )
    for diff in rsltrace.diff(a, b), rsltrace.diff(b, a):
        assert "/source is constructed in" in diff.sentence
        assert "likely cause" not in diff.sentence
        assert diff.divergences[0].calls, "which still shows them"


def test_periods_that_differ_are_shown_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    a = recorded(tmp_path, "a.mcap", monkeypatch)
    b = recorded(tmp_path, "b.mcap", monkeypatch, PERIOD="0.1000001")
    assert "timer period 100 → 100.0001 ms" in rsltrace.diff(a, b).sentence
    assert "timer period 100.0001 → 100 ms" in rsltrace.diff(b, a).sentence


def test_the_period_shows_where_a_timer_is_first_reset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = "nodes: [{node: 'changed_nodes:Guarded'}]\nstop: {duration: 1s}\n"
    a = recorded(tmp_path, "a.mcap", monkeypatch, job)
    b = recorded(tmp_path, "b.mcap", monkeypatch, job, PERIOD="0.4")
    assert "timer Guarded.expired: period 500 → 400 ms" in rsltrace.diff(a, b).sentence
    assert "timer Guarded.expired: period 400 → 500 ms" in rsltrace.diff(b, a).sentence


def test_a_main_that_makes_its_nodes_in_another_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = "nodes: [{main: 'changed_nodes:main'}]\nstop: {duration: 1s}\n"
    a = recorded(tmp_path, "a.mcap", monkeypatch, job)
    b = recorded(tmp_path, "b.mcap", monkeypatch, job, FIRST="sink")
    told = "the nodes are constructed in a different order: /source first in a, /sink in b"
    assert rsltrace.diff(a, b).sentence.lower().startswith(told)
    assert "first in a, /source in b" in rsltrace.diff(b, a).sentence


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("groups", "told"),
    [
        (("own", ""), "mutually exclusive 1 → default, in a that of timer Busy.work"),
        (("", "own"), "default → mutually exclusive 1, in b that of timer Busy.work"),
        (("own", "free"), "mutually exclusive 1 → reentrant 2, in a that of timer Busy.work"),
    ],
)
def test_another_callback_group(
    groups: tuple[str, str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b = (
        recorded(tmp_path, f"{name}.mcap", monkeypatch, BUSY, GROUP=group)
        for name, group in zip("ab", groups, strict=True)
    )
    diff = rsltrace.diff(a, b)
    assert f"/busy created timer Busy.more with a different callback group: {told}" in diff.sentence


def test_members_of_a_callback_group_of_another_kind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b = (
        recorded(tmp_path, f"{kind}.mcap", monkeypatch, BUSY, GROUP="own", KIND=kind)
        for kind in ("exclusive", "free")
    )
    both = "timer Busy.work and timer Busy.more with a different callback group: "
    assert f"/busy created {both}mutually exclusive 1 → reentrant 1" in rsltrace.diff(a, b).sentence


def test_a_callback_group_that_depends_on_a_parameter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_it = BUSY.replace(":Busy", ":Busy\n    parameters: {free: true}")
    a = recorded(tmp_path, "a.mcap", monkeypatch, BUSY, GROUP="own")
    b = recorded(tmp_path, "b.mcap", monkeypatch, with_it, GROUP="own")
    sentence = rsltrace.diff(a, b).sentence
    assert "arameter" in sentence.partition("; first effect: timer Busy.more of /busy ran")[0]
    cause = "timer Busy.work and timer Busy.more with a different callback group: "
    assert f"likely cause: /busy created {cause}mutually exclusive 1 → reentrant 1" in sentence
