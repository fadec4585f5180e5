"""A trace with a message of every kind that the Rerun export draws, written without ROS.

rosbags serializes the messages and writes their schemas; ``Feeder`` (tests/trace/make.py) does the
bookkeeping. Every step publishes each topic once, from one timer of one node, so the n-th message
of a topic comes from event ``FIRST_EVENT + n``.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import trace_maker
from rosbags.typesys import Stores, get_typestore

from rsltrace.trace.format import TOPIC_ROSOUT
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind

STORE = get_typestore(Stores.ROS2_JAZZY)
MS = 1_000_000
START_NS = 5_000 * MS
STEP_NS = 100 * MS
FIRST_EVENT = 1
LEVELS = (10, 20, 30, 40, 50)


def new(type_name: str, **fields: Any) -> Any:
    """Return a message of a type; fields that are not given are zero, empty or default."""
    cls = STORE.types[type_name]
    values = {}
    for name, (kind, detail) in STORE.fielddefs[type_name][1]:
        values[name] = fields.pop(name) if name in fields else _default(int(kind), detail)
    assert not fields, f"{type_name} has no {sorted(fields)}"
    return cls(**values)


def _default(kind: int, detail: Any) -> Any:
    if kind == 1:
        return "" if detail[0] == "string" else (False if detail[0] == "bool" else 0)
    if kind == 2:
        return new(detail)
    (item_kind, item), size = detail
    count = size if kind == 3 else 0
    if int(item_kind) == 1 and item[0] != "string":
        return np.zeros(count, dtype="uint8" if item[0] in ("byte", "char") else item[0])
    return [_default(int(item_kind), item) for _ in range(count)]


def header(stamp_ns: int, frame: str) -> Any:
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    stamp = new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def point(x: float, y: float, z: float = 0.0) -> Any:
    return new("geometry_msgs/msg/Point", x=x, y=y, z=z)


def turn(yaw: float) -> Any:
    return new("geometry_msgs/msg/Quaternion", z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def pose(x: float, y: float, yaw: float = 0.0) -> Any:
    return new("geometry_msgs/msg/Pose", position=point(x, y), orientation=turn(yaw))


def vector(x: float, y: float, z: float = 0.0) -> Any:
    return new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def colour(r: float, g: float, b: float) -> Any:
    return new("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=1.0)


def messages(step: int, stamp_ns: int, shift: float = 0.0) -> dict[str, tuple[str, Any]]:
    """Return what is published at a step: by topic, the type and the message."""
    angle = step * 0.1
    x, y = 3 * math.cos(angle) + shift, 3 * math.sin(angle)
    here = pose(x, y, angle + math.pi / 2)
    odom = header(stamp_ns, "odom")
    base = header(stamp_ns, "base_link")
    cloud = np.random.default_rng(step).normal(size=(50, 3)).astype("<f4")
    fields = [
        new("sensor_msgs/msg/PointField", name=name, offset=4 * place, datatype=7, count=1)
        for place, name in enumerate("xyz")
    ]
    image = np.full((8, 8, 3), step % 256, dtype=np.uint8)
    stamped = [
        new("geometry_msgs/msg/PoseStamped", header=odom, pose=pose(math.cos(a), math.sin(a)))
        for a in np.linspace(0, 6, 20).tolist()
    ]
    transform = new(
        "geometry_msgs/msg/TransformStamped",
        header=odom,
        child_frame_id="base_link",
        transform=new(
            "geometry_msgs/msg/Transform", translation=vector(x, y), rotation=turn(angle + 1.57)
        ),
    )
    marker = new(
        "visualization_msgs/msg/Marker",
        header=odom,
        ns="boxes",
        id=step % 3,
        type=1,
        action=0 if step % 7 else 2,
        pose=pose(step % 3, -1.0),
        scale=vector(0.5, 0.5, 0.5),
        color=colour(1, 0, 0),
    )
    line = new(
        "visualization_msgs/msg/Marker",
        header=odom,
        ns="lines",
        type=4,
        points=[point(0, 0), point(x, y)],
        scale=vector(0.05, 0, 0),
        color=colour(0, 1, 0),
    )
    twist = new("geometry_msgs/msg/Twist", linear=vector(0.3, 0), angular=vector(0, 0, 0.1))
    return {
        "/tf": ("tf2_msgs/msg/TFMessage", new("tf2_msgs/msg/TFMessage", transforms=[transform])),
        "/odom": (
            "nav_msgs/msg/Odometry",
            new(
                "nav_msgs/msg/Odometry",
                header=odom,
                child_frame_id="base_link",
                pose=new("geometry_msgs/msg/PoseWithCovariance", pose=here),
                twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist),
            ),
        ),
        "/scan": (
            "sensor_msgs/msg/LaserScan",
            new(
                "sensor_msgs/msg/LaserScan",
                header=base,
                angle_min=-1.0,
                angle_max=1.0,
                angle_increment=0.5,
                range_min=0.1,
                range_max=10.0,
                ranges=np.array([1.0, 2.0, math.inf, math.nan, 1.5 + shift], dtype=np.float32),
            ),
        ),
        "/cloud": (
            "sensor_msgs/msg/PointCloud2",
            new(
                "sensor_msgs/msg/PointCloud2",
                header=base,
                height=1,
                width=50,
                fields=fields,
                point_step=12,
                row_step=600,
                data=np.frombuffer(cloud.tobytes(), dtype=np.uint8),
            ),
        ),
        "/camera/image": (
            "sensor_msgs/msg/Image",
            new(
                "sensor_msgs/msg/Image",
                header=header(stamp_ns, "camera"),
                height=8,
                width=8,
                encoding="rgb8",
                step=24,
                data=image.reshape(-1),
            ),
        ),
        "/plan": ("nav_msgs/msg/Path", new("nav_msgs/msg/Path", header=odom, poses=stamped)),
        "/particles": (
            "geometry_msgs/msg/PoseArray",
            new("geometry_msgs/msg/PoseArray", header=odom, poses=[here, pose(0, step * 0.01)]),
        ),
        "/goal": (
            "geometry_msgs/msg/PoseStamped",
            new("geometry_msgs/msg/PoseStamped", header=odom, pose=here),
        ),
        "/markers": (
            "visualization_msgs/msg/MarkerArray",
            new("visualization_msgs/msg/MarkerArray", markers=[marker, line]),
        ),
        "/marker": ("visualization_msgs/msg/Marker", line),
        "/cmd_vel": ("geometry_msgs/msg/Twist", twist),
        "/imu": ("sensor_msgs/msg/Imu", new("sensor_msgs/msg/Imu", header=base)),
        "/fix": (
            "sensor_msgs/msg/NavSatFix",
            new("sensor_msgs/msg/NavSatFix", header=base, latitude=47 + y * 1e-5, longitude=8.0),
        ),
        "/joints": (
            "sensor_msgs/msg/JointState",
            new(
                "sensor_msgs/msg/JointState",
                header=base,
                name=["left", "right"],
                position=np.array([angle, -angle]),
            ),
        ),
        "/map": (
            "nav_msgs/msg/OccupancyGrid",
            new(
                "nav_msgs/msg/OccupancyGrid",
                header=header(stamp_ns, "odom"),
                info=new(
                    "nav_msgs/msg/MapMetaData",
                    resolution=0.5,
                    width=16,
                    height=16,
                    origin=pose(-4, -4),
                ),
                data=np.tile(np.array([0, 100], dtype=np.int8), 128),
            ),
        ),
        "/voltage": ("std_msgs/msg/Float64", new("std_msgs/msg/Float64", data=12.0 - step * 0.01)),
        "/status": ("std_msgs/msg/String", new("std_msgs/msg/String", data=f"step {step}")),
        "/wheels": (
            "std_msgs/msg/Float32MultiArray",
            new("std_msgs/msg/Float32MultiArray", data=np.array([1, step], dtype=np.float32)),
        ),
    }


def write_gallery(
    path: Path, steps: int, *, differs_from: int | None = None, close: bool = True
) -> trace_maker.Feeder:
    """Write ``steps`` steps; from ``differs_from`` on, what is published is shifted by 0.5 m."""
    with trace_maker.Opened(path, force=True) as feeder:
        writer = feeder.writer
        node = feeder.entity(EntityKind.NODE, "/robot", created_ns=START_NS)
        timer = feeder.entity(EntityKind.TIMER, "Robot.on_timer", node=node, created_ns=START_NS)
        feeder.output(OutputKind.ENTITY, node, b"node")
        rosout = feeder.entity(
            EntityKind.PUBLISHER, TOPIC_ROSOUT, node=node, type_="rcl_interfaces/msg/Log"
        )
        publishers: dict[str, tuple[int, int]] = {}
        for topic, (type_name, _) in messages(0, START_NS).items():
            publisher = feeder.entity(EntityKind.PUBLISHER, topic, node=node, type_=type_name)
            text, type_hash = STORE.generate_msgdef(type_name, ros_version=2)
            publishers[topic] = (
                publisher,
                writer.add_channel(topic, type_name, text, type_hash=type_hash),
            )
        log_channel = writer.add_channel(
            TOPIC_ROSOUT, "rcl_interfaces/msg/Log", trace_maker.LOG_SCHEMA
        )
        watcher = feeder.entity(EntityKind.NODE, "/watcher", created_ns=START_NS)
        odom = feeder.entity(
            EntityKind.SUBSCRIPTION, "/odom", node=watcher, type_="nav_msgs/msg/Odometry"
        )
        feeder.event(EventKind.CONSTRUCT, 0, START_NS)
        for step in range(steps):
            stamp_ns = START_NS + (step + 1) * STEP_NS
            shift = 0.5 if differs_from is not None and step >= differs_from else 0.0
            for topic, (type_name, message) in messages(step, stamp_ns, shift).items():
                publisher, channel = publishers[topic]
                data = bytes(STORE.serialize_cdr(message, type_name))
                feeder.output(
                    OutputKind.MESSAGE, publisher, data, feeder.payload(channel, stamp_ns, data)
                )
            log = trace_maker.log_message(stamp_ns, LEVELS[step % 5], "robot", f"step {step}")
            feeder.output(OutputKind.LOG, rosout, log, feeder.payload(log_channel, stamp_ns, log))
            sent = feeder.event(EventKind.TIMER, timer, stamp_ns, input_hash=step)
            feeder.event(
                EventKind.SUBSCRIPTION, odom, stamp_ns, input_hash=step * 2, cause=(sent, 1)
            )
        end_ns = START_NS + (steps + 1) * STEP_NS
        text = "Traceback (most recent call last):\nValueError: too far\n"
        feeder.detail(OutputKind.EXCEPTION, timer, end_ns, text)
        feeder.event(EventKind.TIMER, timer, end_ns, flags=EventFlag.RAISED)
        if close:
            feeder.writer.close(
                result={
                    "start_time": str(START_NS),
                    "end_time": str(end_ns),
                    "stop_reason": "duration",
                    "exit_code": "0",
                }
            )
    return feeder
