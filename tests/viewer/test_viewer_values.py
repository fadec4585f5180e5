"""Rows say what was sent: values of messages, and how much later run b was."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import make_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rsltrace_viewer.model.plots.series import PlotSource, most_telling
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.message_values import message_values, samples, varying_values
from rsltrace_viewer.session import Session
from trace_maker import Opened, uint64_message

from rsltrace.diff.row_sign import RowSign
from rsltrace.errors import TraceError
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind

SAMPLES = Path(__file__).parents[2] / "sample_traces"


def message(**fields: Any) -> Any:
    return make_dataclass("Made", list(fields))(**fields)


@pytest.mark.parametrize(
    ("made", "text"),
    [
        (
            message(linear=message(x=0.31, y=0.0, z=-0.0), angular=message(x=0.0, y=0.0, z=-0.05)),
            "x=0.31 ω=-0.05",
        ),
        (message(x=0.0, y=0.0), "x=0 y=0"),
        (message(data=7), "7"),
        (message(header=message(stamp=1, frame_id="map"), ok=True, text="a\x1b[2J"), None),
        (message(orientation=message(x=0.0, y=0.0, z=1.0, w=0.0)), "3.142"),
        (
            message(ranges=np.zeros(360), covariance=np.ones(36), gain=2.5),
            "ranges=[360 items] gain=2.5",
        ),
        (message(a=message(x=1.0), b=message(x=2.0)), "a.x=1 b.x=2"),
        (message(pair=np.array([1.5, 2.0]), empty=[]), "pair=[1.5 2]"),
    ],
)
def test_messages_in_a_few_words(made: Any, text: str | None) -> None:
    assert message_values(made) == (text or 'ok=true text="a\\x1b[2J"')


STORE = get_typestore(Stores.ROS2_HUMBLE)


def ros_message(name: str, /, **fields: Any) -> Any:
    """Return a message of a type of ROS, zero but for some fields."""
    made = STORE.types[name](**{field: zero(kind) for field, kind in STORE.fielddefs[name][1]})
    for field, value in fields.items():
        setattr(made, field, value)
    return made


def zero(kind: Any) -> Any:
    node, detail = kind
    if node is Nodetype.NAME:
        return ros_message(detail)
    if node is Nodetype.BASE:
        return "" if detail[0] == "string" else 0
    return np.zeros(detail[1] if node is Nodetype.ARRAY else 0)


def transform(x: float) -> Any:
    made = ros_message("geometry_msgs/msg/TransformStamped", child_frame_id="base_link")
    made.header.frame_id, made.transform.translation.x = "odom", x
    return made


def vector(**parts: float) -> Any:
    return ros_message("geometry_msgs/msg/Vector3", **parts)


def odometry(x: float, speed: float) -> Any:
    made = ros_message("nav_msgs/msg/Odometry")
    made.pose.pose.position.x = x
    made.twist.twist.linear, made.twist.twist.angular = vector(x=speed), vector(z=-0.1)
    return made


FIX = "47.100000°, -8.000000°, 0 m high"


def test_common_messages_say_what_one_wants_to_know() -> None:
    sensor, nav = "sensor_msgs/msg", "nav_msgs/msg"
    ranges = np.array([0.4, 8.9, np.inf], dtype=np.float32)
    pose = ros_message("geometry_msgs/msg/PoseStamped")
    pose.pose.position.y = 3.0
    status = [
        ros_message("diagnostic_msgs/msg/DiagnosticStatus", level=level, name=name, message="low")
        for level, name in ((1, "battery"), (0, "lidar"))
    ]
    cases = [
        (transform(1.2), "odom→base_link x=1.2"),
        (
            ros_message("tf2_msgs/msg/TFMessage", transforms=[transform(1.2), transform(3.0)]),
            "odom→base_link x=1.2 and 1 more",
        ),
        (ros_message("tf2_msgs/msg/TFMessage"), "no transforms"),
        (
            ros_message("tf2_msgs/msg/TFMessage", transforms=[transform(1.2)] * 20),
            "odom→base_link x=1.2 and 19 more",
        ),
        (ros_message("geometry_msgs/msg/TransformStamped"), "?→? x=0 y=0"),
        (ros_message(f"{sensor}/LaserScan", ranges=ranges), "3 ranges 0.4–8.9 m"),
        (ros_message(f"{sensor}/LaserScan", ranges=ranges[1:]), "2 ranges 8.9 m"),
        (ros_message(f"{sensor}/LaserScan", ranges=ranges[2:]), "1 range, all inf"),
        (ros_message(f"{sensor}/LaserScan", ranges=[np.inf, np.nan]), "2 ranges, all NaN or inf"),
        (ros_message(f"{sensor}/LaserScan"), "no ranges"),
        (ros_message(f"{sensor}/Image"), "0x0"),
        (ros_message(f"{sensor}/PointCloud2"), "0 points"),
        (ros_message(f"{sensor}/PointCloud2", width=1, height=1), "1 point"),
        (
            ros_message(f"{sensor}/JointState", position=np.array([0.5, np.nan])),
            "0.5 nan (no names)",
        ),
        (ros_message(f"{sensor}/JointState"), "no joints"),
        (ros_message("std_msgs/msg/String"), '""'),
        (ros_message("std_msgs/msg/Float64", data=np.nan), "nan"),
        (ros_message(f"{sensor}/Image", width=640, height=480, encoding="rgb8"), "640x480 rgb8"),
        (
            ros_message(f"{sensor}/CompressedImage", format="jpeg", data=np.zeros(2500, np.uint8)),
            "jpeg 2.5 kB",
        ),
        (ros_message(f"{sensor}/PointCloud2", width=6000, height=2), "12,000 points"),
        (
            ros_message(f"{sensor}/JointState", name=["arm", "hand"], position=np.array([0.5, 1])),
            "arm=0.5 hand=1",
        ),
        (ros_message(f"{sensor}/JointState", name=list("abcdefg")), "a b c d e and 2 more"),
        (ros_message(f"{nav}/Path", poses=[pose, pose]), "2 poses to y=3"),
        (ros_message(f"{nav}/Path"), "0 poses"),
        (ros_message(f"{nav}/OccupancyGrid"), "0x0 cells of 0 m"),
        (odometry(1.2, 0.5), "x=1.2 vx=0.5 ω=-0.1"),
        (odometry(0, 0.5), "vx=0.5 ω=-0.1"),
        (ros_message(f"{nav}/Odometry"), "x=0 y=0"),
        (ros_message(f"{sensor}/Imu"), "ω=0 a=0"),
        (ros_message(f"{sensor}/Imu", linear_acceleration=vector(z=9.806)), "az=9.806"),
        (ros_message(f"{sensor}/NavSatFix", latitude=47.1, longitude=-8), FIX),
        (
            ros_message(
                f"{sensor}/NavSatFix", status=ros_message(f"{sensor}/NavSatStatus", status=-1)
            ),
            "no fix",
        ),
        (
            ros_message(
                "rcl_interfaces/msg/ParameterEvent",
                new_parameters=[ros_message("rcl_interfaces/msg/Parameter", name="rate")] * 2,
                changed_parameters=[],
            ),
            "rate and 1 more",
        ),
        (
            ros_message(
                "rcl_interfaces/msg/ParameterEvent",
                deleted_parameters=[ros_message("rcl_interfaces/msg/Parameter", name="rate")],
            ),
            "deleted rate",
        ),
        (ros_message("diagnostic_msgs/msg/DiagnosticArray"), "no status"),
        (
            ros_message(
                "diagnostic_msgs/msg/DiagnosticArray",
                status=[ros_message("diagnostic_msgs/msg/DiagnosticStatus", name="motor")],
            ),
            "OK motor",
        ),
        (
            ros_message("diagnostic_msgs/msg/DiagnosticArray", status=status),
            "WARN battery: low and 1 more",
        ),
        (ros_message("visualization_msgs/msg/MarkerArray"), "0 markers"),
        (
            ros_message("trajectory_msgs/msg/JointTrajectory", joint_names=["arm"]),
            "0 points for arm",
        ),
    ]
    for made, text in cases:
        assert message_values(made) == text


def test_a_type_of_that_name_with_other_fields_is_shown_as_any() -> None:
    made = make_dataclass("Made", ["size"], namespace={"__msgtype__": "sensor_msgs/msg/Image"})
    assert message_values(made(size=7)) == "7"
    scan = make_dataclass(
        "Made", ["ranges"], namespace={"__msgtype__": "sensor_msgs/msg/LaserScan"}
    )
    assert "a" in message_values(scan(ranges=["a"]))


def test_values_that_vary_on_a_topic_come_first() -> None:
    def battery(percentage: float) -> Any:
        return message(a=1, b=2, c=3, d=4, e=5, present=True, percentage=percentage, cell=0)

    def decode(data: bytes) -> Any:
        if data == b"damaged":
            raise TraceError("it cannot be read")
        return battery(float(data))

    payloads = [b"0.5", None, b"damaged", b"0.0", b"1" * (1 << 20)]
    varying = varying_values("a/msg/Battery", payloads, decode)
    assert varying == {"percentage"}
    assert not varying_values("sensor_msgs/msg/JointState", payloads, decode)  # it has a summary
    assert message_values(battery(0.0), varying) == "percentage=0 a=1 b=2 c=3 d=4"
    assert message_values(message(x=0.0, ω=1.0), {"x"}) == "x=0 ω=1"


def test_a_plot_begins_with_a_field_that_differs_or_varies() -> None:
    fields = [PlotSource("field", "/pose", name) for name in ("stamp", "x", "turn", "value")]

    def run(*rows: tuple[int, int, int, int]) -> list[object]:
        return [message(stamp=s, x=x, turn=t, value=v) for s, x, t, v in rows]

    a = run((0, 1, 5, 7), (1, 2, 5, 7))
    assert most_telling(fields, [a]).field == "x"
    assert most_telling(fields, [a, run((0, 1, 6, 7), (1, 2, 6, 7))]).field == "turn"
    assert most_telling(fields, [run((0, 1, 5, 7))]).field == "value"
    assert most_telling(fields, []).field == "value"


@given(st.integers(0, 10**6))
def test_samples_are_messages_of_the_topic(count: int) -> None:
    found = samples(count, 4)
    assert all(0 <= number < count for number in found)
    assert not count or {0, count - 1} <= set(found)


@pytest.mark.parametrize(
    ("name", "plot", "text"),
    [
        ("schedule", ("/torque", ""), "↓ a 7 /torque -1.148 → -0.5748"),
        (
            "nondeterministic_callback",
            ("/push", "x"),
            "/push x -0.19956212899502732 → -0.19956212899502734",
        ),
    ],
)
def test_rows_and_plots_of_two_runs_show_what_differs(
    name: str, plot: tuple[str, str], text: str
) -> None:
    session = Session(*(Run.open(SAMPLES / name / f"{run}.mcap") for run in "ab"))
    try:
        comparison = session.comparison
        assert comparison is not None
        comparison.finish_diff()
        assert session.plots().first() == plot
        rows = [row for row in range(comparison.count) if comparison.sign(row) is RowSign.DIFFERS]
        list(session.read_values(rows))
        assert any(session.row(row).event.outputs.startswith(text) for row in rows)
    finally:
        session.close()


def test_rows_have_values_once_they_are_read(made: Path) -> None:
    run = Run.open(made)
    session = Session(run)
    assert session.row(2).event.outputs == "/count"
    assert list(session.read_values(range(20))) == list(range(1, 21))
    sent = session.row(2).event.outputs.split()
    assert sent[0] == "/count"
    assert session.row(3).event.outputs == f"got {sent[1]}"
    assert session.row(11).event.outputs == "call /check"  # a request without fields
    session.close()


def test_rows_say_how_much_later_run_b_was() -> None:
    folder = SAMPLES / "delayed_input"
    session = Session(Run.open(folder / "a.mcap"), Run.open(folder / "b.mcap"))
    assert session.comparison is not None
    names = [column.name for column, _ in session.columns(120).columns]
    assert "delta" in names
    assert session.row(session.row_of_place()).event.delta == "+15 ms"
    assert session.row(0).event.delta == ""
    session.close()


def test_times_since_1970_count_from_the_start(tmp_path: Path, drive: Callable[..., None]) -> None:
    start = 1_700_000_000_000_000_000
    path = tmp_path / "epoch.mcap"
    with Opened(path) as feeder:
        node = feeder.entity(EntityKind.NODE, "/n", created_ns=start)
        timer = feeder.entity(EntityKind.TIMER, "tick", node=node, created_ns=start)
        sender = feeder.entity(
            EntityKind.PUBLISHER, "/c", node=node, type_="std_msgs/msg/UInt64", created_ns=start
        )
        channel = feeder.writer.add_channel("/c", "std_msgs/msg/UInt64", "uint64 data\n")
        for place in range(50):
            stamp, data = start + place * 100_000_000, uint64_message(place)
            feeder.output(OutputKind.MESSAGE, sender, data, feeder.payload(channel, stamp, data))
            feeder.event(EventKind.TIMER, timer, stamp)
        feeder.writer.close(result={"stop_reason": "done", "exit_code": "0"})

    session = Session(Run.open(path), Run.open(SAMPLES / "schedule" / "a.mcap"))
    lanes, _ = session.lanes(50)
    assert lanes.window.end < 20_000_000_000  # each run from its own start
    assert {lane.run for lane in lanes.lanes if any(lane.levels[:2])} == {"a", "b"}
    session.go(session.show_event(40, other=False))
    assert session.lanes(50)[1] == 4_000_000_000
    assert session.current() == (session.a, 40)
    assert session.place_after(4_000_000_000) == session.view.place_of(40)
    session.close()

    async def steps(viewer: Any) -> None:
        assert "17000000" not in viewer.text.split("\n", 1)[1].partition("event 0")[0]
        assert "from 2023-11-14 22:13:20 UTC" in viewer.text
        assert "/c 3" in viewer.text
        await viewer.press("t")
        await viewer.type("1.5")
        assert viewer.place == 15
        assert "1.500000000 s" in viewer.text
        assert "1700000001" not in viewer.text
        await viewer.press("t")
        await viewer.type("@1700000002")
        assert viewer.place == 20

    drive(path, steps, size=(140, 30))
