"""Faults in real rclpy nodes: recorded twice, the second time misbehaving at one event."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

import rsltrace
from rsltrace.diff.facts.causes import Root, Verdict
from rsltrace.diff.result import Diff
from rsltrace.diff.sentences.values import setting_name
from tests.tiers import cases

pytestmark = pytest.mark.ros

NODES = '''
import os
import random

from rclpy.action import ActionClient
from rclpy.node import Node
from std_msgs.msg import Float64, UInt64
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

MODE = os.environ.get("FAULTY_MODE", "")  # what no trace tells: a hidden input
AT = int(os.environ.get("FAULTY_AT", "7"))


class Sensor(Node):
    """Publishes a reading every 100 ms."""

    def __init__(self):
        super().__init__("sensor")
        self.declare_parameter("gain", 1.0)
        self.publisher = self.create_publisher(Float64, "reading", 10)
        self.goals = ActionClient(self, Fibonacci, "count") if MODE == "goal" else None
        self.count = 0
        self.timer = self.create_timer(0.1, self.tick)

    def tick(self):
        self.count += 1
        if MODE == "late" and self.count == AT - 1:
            self.timer.timer_period_ns = 130_000_000
        elif MODE == "late" and self.count == AT:
            self.timer.timer_period_ns = 100_000_000
        value = self.count * self.get_parameter("gain").value
        if MODE == "bit" and self.count == AT:
            value += 1e-12
        if MODE == "drop" and self.count == AT:
            return
        if MODE == "raise" and self.count == AT:
            raise ValueError("the sensor is unplugged")
        self.publisher.publish(Float64(data=value))
        if MODE == "extra" and self.count == AT:
            self.publisher.publish(Float64(data=value))
        if MODE == "random":
            self.publisher.publish(Float64(data=random.random()))
        if self.goals:
            self.goals.send_goal_async(Fibonacci.Goal())


class Filter(Node):
    """Smooths readings and asks a service now and then: feedback through its state."""

    def __init__(self):
        super().__init__("filter")
        self.value = 0.0
        self.heard = 0
        self.publisher = self.create_publisher(Float64, "smooth", 10)
        self.create_subscription(Float64, "reading", self.got, 10)
        self.client = self.create_client(Trigger, "check")

    def got(self, message):
        self.heard += 1
        self.value = 0.5 * self.value + 0.5 * message.data
        if MODE == "state" and self.heard == AT:
            self.value += 1.0  # and in all it publishes from here on
        if MODE == "silent" and self.heard == AT:
            return
        self.publisher.publish(Float64(data=self.value))
        if self.heard % 3 == 0:
            self.client.call_async(Trigger.Request())


class Checker(Node):
    def __init__(self):
        super().__init__("checker")
        self.asked = 0
        self.create_service(Trigger, "check", self.check)
        self.create_subscription(Float64, "smooth", lambda message: None, 10)
        if MODE == "refuse":
            raise RuntimeError("no")
        if MODE == "graph":
            self.create_publisher(UInt64, "unexpected", 1)

    def check(self, request, response):
        self.asked += 1
        response.success = True
        response.message = f"{self.asked}"
        if MODE == "service" and self.asked == AT:
            response.message = "2 "
        return response
'''
JOB = """
nodes:
  - {node: "faulty_nodes:Sensor", parameters: {gain: GAIN}}
  - {node: "faulty_nodes:Filter"}
  - {node: "faulty_nodes:Checker"}
stop: {duration: 2s}
seed: SEED
"""


@pytest.fixture
def diffed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Diff]:
    """Record twice, the second run in a mode of its own, and diff."""
    (tmp_path / "faulty_nodes.py").write_text(NODES)

    def go(mode: str = "", *, both: str = "", gain: str = "1.0", seed: int = 0) -> Diff:
        from rsltrace.run import run

        runs = (("a", both, "1.0", 0), ("b", mode or both, gain, seed))
        for name, its_mode, its_gain, its_seed in runs:
            monkeypatch.setenv("FAULTY_MODE", its_mode)
            job = tmp_path / "job.yaml"
            job.write_text(JOB.replace("GAIN", its_gain).replace("SEED", str(its_seed)))
            result = run(rsltrace.load_job(job), tmp_path / f"{name}.mcap", force=True)
            assert result.error is None or its_mode in ("raise", "refuse")
        return rsltrace.diff(tmp_path / "a.mcap", tmp_path / "b.mcap")

    return go


@pytest.mark.long
def test_nothing_planted(diffed: Callable[..., Diff]) -> None:
    assert diffed().identical
    assert diffed(both="random").identical


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("mode", "verdict", "root", "node", "entity"),
    [
        ("bit", Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, "/sensor", "Sensor.tick"),
        ("drop", Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, "/sensor", "Sensor.tick"),
        ("extra", Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, "/sensor", "Sensor.tick"),
        ("service", Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, "/checker", "/check"),
        ("raise", Verdict.EXCEPTION, Root.EXCEPTION, "/sensor", "Sensor.tick"),
        ("late", Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, "/sensor", "Sensor.tick"),
    ],
)
def test_a_node_that_misbehaves_once(
    diffed: Callable[..., Diff],
    mode: str,
    verdict: Verdict,
    root: Root,
    node: str,
    entity: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if mode == "service":
        monkeypatch.setenv("FAULTY_AT", "2")
    diff = diffed(mode)
    (first,) = diff.divergences
    assert (diff.verdict, first.root) == (verdict, root), diff.sentence
    assert first.a is not None
    assert first.b is not None
    assert first.a.index == first.b.index == diff.agreeing
    assert (first.a.entity.node, first.a.entity.name) == (node, entity)
    assert first.a.position == {"service": 1, "late": 5}.get(mode, 6)
    if mode == "bit":
        (message,) = first.messages
        (field,) = message.fields
        assert (message.topic, field.path, field.ulp) == ("/reading", "data", 1126)
        assert {reach.topic for reach in first.reaches} == {"/reading", "/smooth"}
    if mode == "drop":
        assert [m.presence for m in first.messages] == ["only a"]
    if mode == "extra":
        assert [m.presence for m in first.messages] == ["only b"]
    if mode == "raise":
        assert "raised an exception only in b: ValueError: the sensor is unplugged" in diff.sentence


def test_a_constructor_that_raises(diffed: Callable[..., Diff]) -> None:
    """It is the same node, though the trace of the failed one does not know its class."""
    diff = diffed("refuse")
    assert (diff.verdict, diff.divergences[0].root) == (Verdict.EXCEPTION, Root.EXCEPTION)
    assert "the constructor of /checker" in diff.sentence
    assert "raised an exception only in b: RuntimeError: no" in diff.sentence


KINDS = {
    "bit": (Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, "/sensor", "Sensor.tick"),
    "drop": (Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, "/sensor", "Sensor.tick"),
    "extra": (Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, "/sensor", "Sensor.tick"),
    "raise": (Verdict.EXCEPTION, Root.EXCEPTION, "/sensor", "Sensor.tick"),
    "state": (Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, "/filter", "/reading"),
    "silent": (Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, "/filter", "/reading"),
    "service": (Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, "/checker", "/check"),
}
CASES = cases(4, 20)


@pytest.mark.long
@pytest.mark.repeated
def test_a_fault_at_any_event_of_real_nodes(
    diffed: Callable[..., Diff], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The callback that misbehaves is named, whichever it is and whenever."""
    rng = random.Random(CASES)
    for number in range(CASES):
        kind = rng.choice(sorted(KINDS))
        at = rng.randrange(1, 7 if kind == "service" else 21)
        monkeypatch.setenv("FAULTY_AT", str(at))
        diff = diffed(kind)
        (first,) = diff.divergences
        assert first.a is not None
        found = (diff.verdict, first.root, first.a.entity.node, first.a.entity.name)
        assert found == KINDS[kind], f"case {number}: {kind} at {at}: {diff.sentence}"
        assert first.a.position == at - 1
        assert first.a.index == diff.agreeing
    print(f"{CASES} of {CASES} right")


def test_another_parameter(diffed: Callable[..., Diff]) -> None:
    diff = diffed(gain="1.5")
    first = diff.divergences[0]
    assert (diff.verdict, first.root) == (Verdict.ENVIRONMENT, Root.JOB)
    assert first.a is not None
    assert first.a.entity.name == "/sensor"
    assert [setting_name(s) for s in diff.settings] == ["job.yaml:3: nodes.0.parameters.gain"]
    assert first.messages[0].topic == "/parameter_events"
    assert diff.sentence == (
        "parameter gain 1.0 → 1.5 (job.yaml:3); first effect: /sensor published a different data "
        "on /reading at 0.1 s (data 1.0 → 1.5)"
    )
    assert diff.shown is diff.effect
    assert diff.effect is not None
    assert diff.effect.a is not None
    assert diff.effect.a.entity.name == "Sensor.tick"
    assert diff.effect.root_sentence == first.root_sentence


@pytest.mark.parametrize("mode", ["random", "goal"])  # rclpy draws the IDs of goals
def test_another_seed(diffed: Callable[..., Diff], mode: str) -> None:
    diff = diffed(both=mode, seed=1)
    (first,) = diff.divergences
    assert (diff.verdict, first.root) == (Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK)
    assert first.a is not None
    assert first.a.entity.node == "/sensor"
    assert [(s.a, s.b) for s in diff.settings] == [("0", "1")]
    assert "job.yaml:7" in first.root_sentence


def test_another_graph(diffed: Callable[..., Diff]) -> None:
    diff = diffed("graph")
    (first,) = diff.divergences
    assert (diff.verdict, first.root) == (Verdict.GRAPH, Root.CALLBACK)
    assert "new publisher /unexpected only in b" in diff.sentence
    assert ("entity", None) in {(s.place, s.a) for s in diff.settings}


DELAYED = JOB + "delay: {topics: {/reading: {uniform: {min: 1ms, max: 20ms}, drop: DROP}}}\n"


def delayed_diff(tmp_path: Path, *, drop: str, seed: int) -> Diff:
    from rsltrace.run import run

    (tmp_path / "faulty_nodes.py").write_text(NODES)
    for name, its_drop, its_seed in (("a", "0", 0), ("b", drop, seed)):
        text = DELAYED.replace("GAIN", "1.0").replace("SEED", str(its_seed))
        (tmp_path / "job.yaml").write_text(text.replace("DROP", its_drop))
        run(rsltrace.load_job(tmp_path / "job.yaml"), tmp_path / f"{name}.mcap", force=True)
    return rsltrace.diff(tmp_path / "a.mcap", tmp_path / "b.mcap")


def test_a_delay_drawn_otherwise_is_the_root_and_is_named(tmp_path: Path) -> None:
    diff = delayed_diff(tmp_path, drop="0", seed=1)
    first = diff.divergences[0]
    assert (diff.verdict, first.root) == (Verdict.DRAW, Root.DRAW)
    assert first.a is not None
    assert (first.a.entity.node, first.a.stamp_ns) == ("/sensor", 100_000_000)
    (message,) = first.messages
    assert message.topic == "subscription /reading of /filter"
    assert all(text.startswith("delay ") for text in (message.fields[0].a, message.fields[0].b))
    assert "job.yaml:7" in first.root_sentence  # the line with the seed
    # What the filter does otherwise follows from that; it is no divergence of its own.
    assert {divergence.verdict for divergence in diff.divergences} == {Verdict.DRAW}


def test_a_message_that_only_one_run_loses_is_named(tmp_path: Path) -> None:
    diff = delayed_diff(tmp_path, drop="0.2", seed=0)  # reliable: it is sent again
    first = diff.divergences[0]
    assert (diff.verdict, first.root) == (Verdict.DRAW, Root.DRAW)
    (field,) = first.messages[0].fields
    a_ms, b_ms = (float(text.split()[1]) for text in (field.a, field.b))
    assert b_ms == pytest.approx(a_ms + 10, abs=1e-3)
    assert "job.yaml:8" in first.root_sentence  # the line with the drop


def test_a_clock_that_jumped_otherwise_is_the_root_and_is_named(tmp_path: Path) -> None:
    """Its node sends what it has read, and only later: that follows, it is no cause of its own."""
    (tmp_path / "clock_nodes.py").write_text(
        """
from rclpy.node import Node
from std_msgs.msg import UInt64

class Reader(Node):
    def __init__(self):
        super().__init__('reader')
        self.seen = 0
        self.publisher = self.create_publisher(UInt64, 'seen', 10)
        self.create_timer(0.1, self.look)
        self.create_timer(0.25, lambda: self.publisher.publish(UInt64(data=self.seen)))

    def look(self):
        self.seen = self.get_clock().now().nanoseconds
"""
    )
    from rsltrace.run import run

    for seed in (0, 1):
        (tmp_path / "job.yaml").write_text(
            "nodes: [{node: clock_nodes:Reader}]\nstart: 10s\nstop: {duration: 1s}\n"
            "clocks: [{node: /reader, random_jumps: {every: 50ms, most: 20ms}}]\n"
            f"seed: {seed}\n"
        )
        run(rsltrace.load_job(tmp_path / "job.yaml"), tmp_path / f"{seed}.mcap", force=True)
    diff = rsltrace.diff(tmp_path / "0.mcap", tmp_path / "1.mcap")
    first = diff.divergences[0]
    assert (diff.verdict, first.root) == (Verdict.DRAW, Root.DRAW)
    (message,) = first.messages
    assert message.topic == "the clock of /reader"
    (field,) = message.fields
    assert {text[:10] for text in (field.a, field.b)} <= {"clock set ", "none"}
    assert "read a clock, but its random draws differ: the clock of /reader" in first.sentence
    assert "job.yaml:5" in first.root_sentence  # the line with the seed
    assert {divergence.verdict for divergence in diff.divergences} == {Verdict.DRAW}
