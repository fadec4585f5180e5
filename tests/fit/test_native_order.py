"""``policy: {recorded: native.mcap}``: the order of a native run, as far as it can be followed."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from rsltrace import RunResult, Trace, record
from rsltrace.job import load_job
from rsltrace.simulation.loop.recorded_order import CALLBACKS
from tests.fit.native_like import as_native

pytestmark = pytest.mark.ros

NODES = """\
from rclpy.node import Node
from std_msgs.msg import Int64


class Talker(Node):
    def __init__(self, name, period):
        super().__init__(name)
        self.says = self.create_publisher(Int64, "/said", 10)
        self.create_timer(period, self.tick)

    def tick(self):
        self.says.publish(Int64())


class Echo(Node):
    def __init__(self, name):
        super().__init__(name)
        self.says = self.create_publisher(Int64, f"/{name}", 10)
        self.create_subscription(Int64, "/said", self.says.publish, 10)


class Sink(Node):
    def __init__(self):
        super().__init__("sink")
        for topic in ("/one", "/two"):
            self.create_subscription(Int64, topic, self.hear, 10)

    def hear(self, message):
        pass
"""
GRAPH = """\
nodes:
  - {node: talk:Talker, arguments: {name: fast, period: 0.05}}
  - {node: talk:Talker, arguments: {name: slow, period: 0.07}}
  - {node: talk:Echo, arguments: {name: one}}
  - {node: talk:Echo, arguments: {name: two}}
  - {node: talk:Sink}
stop: {duration: 3s}
"""
DELAYS = "delay: {default: {uniform: {min: 1ms, max: 90ms}}}\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the run of a job whose order is random, as if native: ``native.mcap``."""
    folder = tmp_path_factory.mktemp("order")
    (folder / "talk.py").write_text(NODES)
    run(folder, "truth", f"{DELAYS}policy: permutation\nseed: 3\n")
    as_native(folder / "truth.mcap", folder / "native.mcap")
    return folder


def run(folder: Path, name: str, more: str, graph: str = GRAPH) -> RunResult:
    (folder / f"{name}.yaml").write_text(graph + more)
    return record(load_job(folder / f"{name}.yaml"), folder / f"{name}.mcap", force=True)


def order(path: Path) -> list[tuple[str, str]]:
    """Return node and name of each callback, in the order in which they ran."""
    with Trace.open(path) as trace:
        count = trace.event_count if trace.ended_after is None else trace.ended_after
        events = [trace.event(index) for index in range(count)]
        entities = [trace.entity(event.entity) for event in events if event.kind in CALLBACKS]
        return [(trace.node_of(entity).name, entity.name) for entity in entities]


@pytest.mark.long
@pytest.mark.parametrize("delays", [DELAYS, ""], ids=["as late", "without delays"])
def test_the_order_of_a_run_that_could_be_simulated_is_followed(folder: Path, delays: str) -> None:
    """Also where messages are there too early: they are held back until their turn."""
    done = run(folder, "again", f"{delays}policy: {{recorded: native.mcap}}\nseed: 3\n")
    truth, found = order(folder / "truth.mcap"), order(folder / "again.mcap")
    counts: Counter[tuple[str, str]] = Counter()
    known = []
    for one in found:
        counts[one] += 1
        if counts[one] <= truth.count(one):
            known.append(one)
    assert known == truth
    assert len(truth) > 300
    (told,) = done.notes
    if delays:
        assert told == "all callbacks of native.mcap ran in its order"
        assert found == truth
    else:  # what was on its way when the native run ended has arrived here
        assert f"{len(truth)} ran in its order, 0 after others" in told
    plain = run(folder, "plain", f"{delays}seed: 3\n")
    assert plain.error is None
    assert order(folder / "plain.mcap") != truth


@pytest.mark.long
def test_it_is_the_same_every_time(folder: Path) -> None:
    text = "delay: {default: 20ms}\npolicy: {recorded: native.mcap}\n"
    assert run(folder, "one", text).digest == run(folder, "two", text).digest


def test_what_comes_too_late_is_passed_over_and_told(folder: Path) -> None:
    """All messages take 150 ms here, at most 90 there: timers do not wait for what they caused."""
    done = run(folder, "late", "delay: {default: 150ms}\npolicy: {recorded: native.mcap}\n")
    counted, first = done.notes
    found, truth = order(folder / "late.mcap"), order(folder / "truth.mcap")
    numbers = [int(word) for word in counted.split() if word.isdigit()]
    count, in_turn, late, missing, others = (*numbers[:1], *numbers[-4:])
    assert in_turn + late + missing == count
    assert in_turn + late + others == len(found)
    assert late > 0
    assert 0 < in_turn < len(truth)
    with Trace.open(folder / "native.mcap") as trace:
        callbacks = [
            index for index in range(trace.event_count) if trace.event(index).kind in CALLBACKS
        ]
    place = next(place for place in range(len(found)) if found[place] != truth[place])
    node, name = truth[place]
    assert f"is event {callbacks[place]}, {node}: subscription {name} at " in first
    assert "was not ready here" in first


def test_a_node_that_is_not_there(folder: Path) -> None:
    without = "".join(line for line in GRAPH.splitlines(keepends=True) if "name: two" not in line)
    text = f"{DELAYS}policy: {{recorded: native.mcap}}\nseed: 3\n"
    counted, first = run(folder, "without", text, without).notes
    truth, found = order(folder / "truth.mcap"), order(folder / "without.mcap")
    gone = [one for one in truth if one in (("/two", "/said"), ("/sink", "/two"))]
    assert f"{len(gone)} not at all; 0 ran" in counted
    assert found == [one for one in truth if one not in gone]
    assert "/two: subscription /said" in first
