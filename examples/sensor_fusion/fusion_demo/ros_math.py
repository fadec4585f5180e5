"""Between ROS messages and plain numbers."""

from __future__ import annotations

import math

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseStamped, Quaternion, Vector3


def stamp_ns(stamp: Time) -> int:
    """Return a message's stamp in nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def yaw_of(orientation: Quaternion) -> float:
    """Return the yaw in radians of an orientation."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def pose_of(x: float, y: float, yaw: float) -> Pose:
    """Return a pose in the plane."""
    pose = Pose()
    pose.position.x = x
    pose.position.y = y
    pose.orientation.z = math.sin(yaw / 2)
    pose.orientation.w = math.cos(yaw / 2)
    return pose


def pose_stamped(frame_id: str, stamp: Time, x: float, y: float, yaw: float) -> PoseStamped:
    """Return a pose in the plane, with its frame and time."""
    stamped = PoseStamped()
    stamped.header.frame_id = frame_id
    stamped.header.stamp = stamp
    stamped.pose = pose_of(x, y, yaw)
    return stamped


class YawRate:
    """The robot's yaw rate from a gyro that is mounted at some angle."""

    def __init__(self, roll: float, pitch: float, yaw: float) -> None:
        """Mounting angles in radians, as a static transform has them. Yaw makes no difference."""
        del yaw
        # The last row of the rotation from the sensor's axes to the robot's.
        self._x = -math.sin(pitch)
        self._y = math.cos(pitch) * math.sin(roll)
        self._z = math.cos(pitch) * math.cos(roll)

    def of(self, angular_velocity: Vector3) -> float:
        """Return the rate in rad/s about the robot's vertical axis."""
        rate = angular_velocity
        return float(self._x * rate.x + self._y * rate.y + self._z * rate.z)
