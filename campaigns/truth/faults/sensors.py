"""Messages of sensors, poses, maps and joints: what differs in them is named as it is."""

from __future__ import annotations

import random

from campaigns.truth.faults.behaviour import Change, behaviour, truth_of
from campaigns.truth.faults.planting import one_of
from campaigns.truth.graph import World

IMPORTS = [
    "from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue",
    "from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion, TransformStamped, Twist",
    "from nav_msgs.msg import OccupancyGrid, Odometry, Path",
    "from sensor_msgs.msg import (",
    "    BatteryState, Image, Imu, JointState, LaserScan, NavSatFix, NavSatStatus, PointCloud2)",
]


def sensor(name: str, made: str, change: str, *first: str, shows: tuple[str, ...] = ()) -> None:
    """Register two classes: a source publishes ``made``, and at one call ``change`` is done."""

    def make(rng: random.Random, world: World) -> Change:
        node = one_of(rng, world, "source")
        kind = made.partition("(")[0]
        node.top += IMPORTS
        node.setup.append(f'self.sensor = self.create_publisher({kind}, "/sensor", 10)')
        lines = node.callbacks[0].lines
        at = lines.index("# before")
        lines[at : at + 1] = [f"sent = {made}", "# before", "self.sensor.publish(sent)"]
        truth = truth_of(node, first=(r"/sensor", *first), shows=shows)
        return Change(node, [change], truth, at=rng.randint(1, 6))

    behaviour(name)(make)


sensor(
    "element of a covariance",
    "PoseWithCovarianceStamped()",
    "sent.pose.covariance[35] = 0.0685",
    r"pose\.covariance\[35\] 0\.0 → 0\.0685",
)
sensor(
    "frame of another robot",
    "Odometry()",
    'sent.child_frame_id = "robot2/base_link"',
    r'child_frame_id "" → "robot2/base_link"',
)
sensor(
    "parent and child of a transform",
    "TransformStamped(child_frame_id='map')",
    "sent.header.frame_id, sent.child_frame_id = sent.child_frame_id, sent.header.frame_id",
    r'header\.frame_id "" → "map" and 1 more field',
    shows=(r"child_frame_id",),
)
sensor(
    "quaternion of the other sign",
    "Quaternion(x=0.5, y=0.5, z=0.5, w=0.5)",
    "sent.x, sent.y, sent.z, sent.w = -sent.x, -sent.y, -sent.z, -sent.w",
    r"x 0\.5 → -0\.5 and 3 more fields",
)
sensor(
    "nanosecond of a stamp",
    "Imu()",
    "sent.header.stamp.nanosec = 1",
    r"header\.stamp 0\.0* → 0\.000000001",
)
sensor(
    "beams of a laser that are lost",
    "LaserScan(ranges=[1.0 + i / 360 for i in range(360)])",
    "for i in range(90, 95): sent.ranges[i] = float('inf')",
    r"5 of 360 elements of ranges",
    shows=(r"\[90\]",),
)
sensor(
    "intensities that are gone",
    "LaserScan(ranges=[1.0, 2.0], intensities=[3.0, 4.0])",
    "sent.intensities = []",
    "intensities",
    shows=("length 2 and 0",),
)
sensor(
    "joints in another order",
    "JointState(name=['left', 'right', 'arm'], position=[0.1, 0.2, 0.3])",
    "sent.name = sent.name[::-1]; sent.position = sent.position[::-1]",
    "name has the same elements in a different order and 1 more field",
)
sensor(
    "name of a joint",
    "JointState(name=['left', 'right'], position=[0.1, 0.2])",
    "sent.name = ['left', 'right_wheel']",
    r'name\[1\] "right" → "right_wheel"',
)
sensor(
    "cell of a map",
    "OccupancyGrid(data=[0] * 400)",
    "sent.data[123] = 100",
    r"data\[123\] 0 → 100",
)
sensor(
    "resolution of a map",
    "OccupancyGrid(data=[0] * 4)",
    "sent.info.resolution = 0.05",
    r"info\.resolution 0\.0 → 0\.05",
)
sensor(
    "points of a cloud",
    "PointCloud2(data=bytes(600))",
    "sent.data[300] = 7",
    r"\bdata\b",
    shows=(r"\b12[cC]|\b300|0x12[0c]|\[288\]|120",),
)
sensor(
    "encoding of an image",
    "Image(encoding='rgb8', data=bytes(30))",
    "sent.encoding = 'bgr8'",
    r'encoding "rgb8" → "bgr8"',
)
sensor(
    "level of a diagnosis",
    "DiagnosticArray(status=[DiagnosticStatus(level=b'\\0', name='motor')])",
    "sent.status[0].level = b'\\2'",
    r"status\[0\]\.level 0 → 2 \(OK → ERROR\)",
)
sensor(
    "value of a diagnosis",
    "DiagnosticArray(status=[DiagnosticStatus(values=[KeyValue(key='T', value='40')])])",
    "sent.status[0].values[0].value = '91'",
    r'status\[0\]\.values\[0\]\.value "40" → "91"',
)
sensor(
    "another diagnosis more",
    "DiagnosticArray(status=[DiagnosticStatus(name='motor')])",
    "sent.status.append(DiagnosticStatus(name='arm'))",
    r"\bstatus\b",
    shows=("length 1 and 2",),
)
sensor(
    "fix of a satellite receiver",
    "NavSatFix(latitude=48.5)",
    "sent.status.status = -1",
    r"status\.status -2 → -1 \(STATUS_UNKNOWN → STATUS_NO_FIX\)|"
    r"status\.status 0 → -1 \(STATUS_FIX → STATUS_NO_FIX\)",
)
sensor(
    "degrees in place of radians",
    "Twist()",
    "sent.angular.z = math.degrees(0.5)",
    r"angular\.z 0\.0 → 28\.6478897\d+",
)
sensor(
    "pose of a path",
    "Path(poses=[PoseStamped() for _ in range(20)])",
    "sent.poses[13].pose.position.x = 1.5",
    r"poses\[13\]\.pose\.position\.x 0\.0 → 1\.5",
)
sensor(
    "path that ends earlier",
    "Path(poses=[PoseStamped() for _ in range(5)])",
    "sent.poses.pop()",
    r"poses 5 items → 4 items",
)
sensor(
    "text in another script",
    "String(data='Größe')",
    "sent.data = '大きさ'",
    'data "Größe" → "大きさ"',
)
sensor(
    "charge that is not known",
    "BatteryState(percentage=0.5)",
    "sent.percentage = float('nan')",
    r"percentage 0\.5 → nan",
    shows=("NaN in b",),
)
