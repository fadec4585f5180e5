"""A layout for Foxglove and Lichtblick: the panels that fit a trace."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from trace_maker import MS, START_NS, Opened, uint64_message, write_run

from rsltrace import Job, NodeSpec, StopSpec, record
from rsltrace.errors import OutputError
from rsltrace.trace.exports.layout import export_layout
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind

EVIL = '/x\x1b[2J\n"\\</script>'


def _ids(layout: Any, configs: dict[str, Any]) -> Iterator[str]:
    if isinstance(layout, dict):
        assert set(layout) == {"direction", "first", "second", "splitPercentage"}
        assert layout["direction"] in ("row", "column")
        assert 0 < layout["splitPercentage"] < 100
        yield from _ids(layout["first"], configs)
        yield from _ids(layout["second"], configs)
        return
    yield layout
    for tab in configs[layout].get("tabs", ()):
        assert set(tab) == {"title", "layout"}
        yield from _ids(tab["layout"], configs)


def layout_of(trace: Path, **more: Any) -> dict[str, list[dict[str, Any]]]:
    """Return the panels by kind, once it is known that the layout shows each of them once."""
    output = trace.with_suffix(".json")
    count = export_layout(trace, output, force=True, **more)
    document = json.loads(output.read_text())
    keys = {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    assert set(document) == keys
    configs = document["configById"]
    assert sorted(_ids(document["layout"], configs)) == sorted(configs)
    panels: dict[str, list[dict[str, Any]]] = {}
    for name, config in configs.items():
        panels.setdefault(name.partition("!")[0], []).append(config)
    assert count == len(configs) - len(panels.get("Tab", ()))
    return panels


def _values(panel: dict[str, Any]) -> list[str]:
    assert all(path["timestampMethod"] == "receiveTime" for path in panel["paths"])
    return [path["value"] for path in panel["paths"]]


@pytest.mark.ros
def test_panels_for_what_a_job_publishes(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Bool, Float64, String

    class Robot(Node):
        def __init__(self) -> None:
            super().__init__("robot")
            kinds = {
                "odom": Odometry, "speed": Float64, "constant": Float64, "gripper": Bool,
                "state": String, "joints": JointState, "silent": Float64,
            }  # fmt: skip
            self.out = {name: self.create_publisher(kind, name, 10) for name, kind in kinds.items()}
            self.count = 0
            self.create_timer(0.1, self.tick)

        def tick(self) -> None:
            self.count += 1
            odom = Odometry()
            odom.header.frame_id, odom.child_frame_id = "map", "base"
            odom.header.stamp = self.get_clock().now().to_msg()
            odom.pose.pose.position.x = self.count / 3
            self.out["odom"].publish(odom)
            self.out["speed"].publish(Float64(data=self.count / 7))
            self.out["constant"].publish(Float64(data=3.0))
            self.out["gripper"].publish(Bool(data=self.count % 8 < 3))
            self.out["state"].publish(String(data="go" if self.count > 9 else "stop"))
            joints = JointState(name=["a", "b"], position=[1.0, float(self.count)])
            self.out["joints"].publish(joints)
            self.get_logger().info("tick")

    job = Job(nodes=[NodeSpec(node=lambda: [Robot()])], stop=StopSpec(duration="3s"))
    record(job, tmp_path / "run.mcap")
    panels = layout_of(tmp_path / "run.mcap")
    assert [_values(panel) for panel in panels["Plot"]] == [
        ["/odom.pose.pose.position.x"], ["/speed.data"], ["/joints.position[1]"],
    ]  # fmt: skip
    assert panels["Plot"][0]["foxglovePanelTitle"] == "/odom"
    (states,) = panels["StateTransitions"]
    assert _values(states) == ["/gripper.data", "/state.data"]
    (scene,) = panels["3D"]
    assert (scene["followTf"], scene["topics"]) == ("map", {"/odom": {"visible": True}})
    (log,) = panels["RosOut"]
    assert log["topicToRender"] == "/rosout"
    raw = [panel["topicPath"] for panel in panels["RawMessages"]]
    assert "/rsltrace/entities" in raw
    assert not {"/rsltrace/events", "/rsltrace/outputs"} & {*raw}  # they read none of these
    some = layout_of(tmp_path / "run.mcap", topics=["/[os]*"], exclude=["/odom"])
    assert [_values(panel) for panel in some["Plot"]] == [["/speed.data"]]
    assert "3D" not in some
    assert "RosOut" not in some


def test_many_topics_are_in_tabs(tmp_path: Path) -> None:
    _published(tmp_path / "run.mcap", [f"/t{number:02}" for number in range(50)])
    panels = layout_of(tmp_path / "run.mcap")
    assert len(panels["Plot"]) == 32
    tabs = next(panel["tabs"] for panel in panels["Tab"] if len(panel["tabs"]) == 8)
    assert [tab["title"] for tab in tabs] == [f"plots {number}" for number in range(1, 9)]


def test_names_from_anybody(tmp_path: Path) -> None:
    _published(tmp_path / "run.mcap", [EVIL, "/rsltrace/y\x1b"])
    panels = layout_of(tmp_path / "run.mcap")
    (plot,) = panels["Plot"]
    assert _values(plot) == ['"/x\x1b[2J\n\\"\\\\</script>".data']
    assert plot["lichtblickPanelTitle"].isprintable()
    text = (tmp_path / "run.json").read_text()
    assert "<" not in text
    assert "\x1b" not in text


def test_an_empty_run(tmp_path: Path) -> None:
    with Opened(tmp_path / "run.mcap") as feeder:
        feeder.writer.close(result={})
    assert list(layout_of(tmp_path / "run.mcap")) == ["SourceInfo"]


def test_the_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    trace, output = tmp_path / "run.mcap", tmp_path / "layout.json"
    write_run(trace, 50)
    output.write_text("precious")
    with pytest.raises(OutputError, match="exists; use --force"):
        export_layout(trace, output)
    os.mkfifo(tmp_path / "pipe")
    for place, message in (
        (trace, "is the trace itself"), (tmp_path / "pipe", "a named pipe"),
        (Path("/dev/null"), "not a regular file"), (tmp_path, "is a folder"),
    ):  # fmt: skip
        with pytest.raises(OutputError, match=message):
            export_layout(trace, place, force=True)
    assert output.read_text() == "precious"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["layout.json", "pipe", "run.mcap"]


def _published(path: Path, topics: list[str]) -> None:
    with Opened(path) as feeder:
        node = feeder.entity(EntityKind.NODE, "/a")
        for topic in topics:
            publisher = feeder.entity(EntityKind.PUBLISHER, topic, node=node)
            channel = feeder.writer.add_channel(topic, "std_msgs/msg/UInt64", "uint64 data\n")
            for number in range(3):
                stamp_ns = START_NS + number * MS
                sequence = feeder.payload(channel, stamp_ns, uint64_message(number))
                feeder.output(OutputKind.MESSAGE, publisher, uint64_message(number), sequence)
        feeder.event(EventKind.TASK, node, START_NS)
        feeder.writer.close(result={})
