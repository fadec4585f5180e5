"""``policy: {recorded: native.mcap}``: the order of a native run."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from rsltrace import RunResult, Trace, record
from rsltrace.job import load_job
from rsltrace.run.plans.recorded_order import EntityNames
from rsltrace.simulation.loop.recorded_order import CALLBACKS
from rsltrace.trace.model.entity import Entity, EntityKind
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
    assert len(truth) > 300
    assert done.notes == (f"all {len(truth)} callbacks of native.mcap ran in its order",)
    assert found[: len(truth)] == truth
    plain = run(folder, "plain", f"{delays}seed: 3\n")
    assert plain.error is None
    assert order(folder / "plain.mcap") != truth


@pytest.mark.long
def test_it_is_the_same_every_time(folder: Path) -> None:
    text = "delay: {default: 20ms}\npolicy: {recorded: native.mcap}\n"
    assert run(folder, "one", text).digest == run(folder, "two", text).digest


def test_what_comes_too_late_is_passed_over_and_told(folder: Path) -> None:
    """All messages take 250 ms here, at most 90 there: others do not wait that long."""
    done = run(folder, "late", "delay: {default: 250ms}\npolicy: {recorded: native.mcap}\n")
    counted, first = done.notes
    found, truth = order(folder / "late.mcap"), order(folder / "truth.mcap")
    followed = next(place for place in range(len(found)) if found[place] != truth[place])
    words = counted.split()
    assert words[:5] == ["of", str(len(truth)), "callbacks", "of", "native.mcap"]
    assert followed <= int(words[5]) < len(truth)
    with Trace.open(folder / "native.mcap") as trace:
        callbacks = [
            index for index in range(trace.event_count) if trace.event(index).kind in CALLBACKS
        ]
    node, name = truth[followed]
    assert f" is event {callbacks[followed]}, {node}: subscription {name} with message 1 " in first
    assert first.endswith("it did not get that message here")


def test_nodes_that_are_not_there_are_played(folder: Path) -> None:
    """This trace holds no messages, only what was sent when."""
    without = "".join(line for line in GRAPH.splitlines(keepends=True) if "name: two" not in line)
    text = "policy: {recorded: native.mcap}\n"
    counted, first, lost = run(folder, "without", text, without).notes
    truth, found = order(folder / "truth.mcap"), order(folder / "without.mcap")
    gone = truth.count(("/sink", "/two"))
    own = [one for one in truth if one[0] != "/two"]
    assert f"of {len(own)} callbacks of native.mcap {len(own) - gone} ran in its order" == counted
    assert first.endswith("that message was not sent here")
    assert lost.startswith("native.mcap does not hold ")
    expected = [one for one in own if one != ("/sink", "/two")]
    assert found[: len(expected)] == expected


def _named(nodes: tuple[str, ...], native: EntityNames | None = None) -> EntityNames:
    """Name nodes, each with a subscription to a topic that is named after it."""
    names = EntityNames(native)
    for number, name in enumerate(nodes):
        names.add(Entity(2 * number + 1, 2 * number + 1, EntityKind.NODE, name, "", 0, {}))
        topic = f"{name.split('_0x')[0]}/heard"
        names.add(Entity(2 * number + 2, 2 * number + 1, EntityKind.SUBSCRIPTION, topic, "", 0, {}))
    return names


def test_nodes_correspond_whose_names_have_other_addresses_and_no_others() -> None:
    native = _named(("/camera_10203040", "/tf_0x5581aa00", "/camera_55667788", "/tf_0x7fffe000"))
    again = _named(
        ("/camera_55667788", "/tf_0x11111111", "/camera_10203040", "/tf_0x22222222"), native
    )
    assert again[1] == native[5]
    assert again[2] == native[6]
    assert again[5] == native[1]
    assert [again[3], again[4]] == [native[3], native[4]]
    assert [again[7], again[8]] == [native[7], native[8]]
    other = _named(("/camera_99999999", "/tf_0x1"), native)
    assert other[3] == "/tf_0x1: node /tf_0x1"
