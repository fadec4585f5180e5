"""The simulated robot: a LiDAR and wheel odometry on a course that is known."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Empty

from lidar_demo.clouds import Array, cloud_of, planar, set_pose
from lidar_demo.course import Course
from lidar_demo.yard import Yard

WHEELS_S = 0.02
SWEEP_NS = 100_000_000
SWEEP_S = SWEEP_NS / 1e9
LAST_WORD_NS = 5 * SWEEP_NS
RANGE_MAX = 60.0


class SimulatedRobot(Node):
    """Publishes /wheel/odom at 50 Hz, and at 10 Hz a sweep on /points with the pose in which it
    ended on /ground_truth; /finished after the last one.

    The robot does not wait for its computer: a sweep that is over before the node comes to it is
    lost (its pose is published all the same). Sweep 17 is always the same.

    Parameters: ``seed`` of the yard and of the noise; ``sweeps`` to be made; ``rings`` and
    ``columns`` of a sweep; ``range_sigma`` [m]; ``wheel_scale`` (1.02: wheels that claim 2 % more)
    and ``wheel_sigma`` [m] in each message.
    """

    def __init__(self) -> None:
        super().__init__("robot")
        seed = int(self.declare_parameter("seed", 1).value)
        self._sweeps = int(self.declare_parameter("sweeps", 100).value)
        rings = int(self.declare_parameter("rings", 16).value)
        columns = int(self.declare_parameter("columns", 360).value)
        self._range_sigma = float(self.declare_parameter("range_sigma", 0.02).value)
        self._wheel_scale = float(self.declare_parameter("wheel_scale", 1.02).value)
        self._wheel_sigma = float(self.declare_parameter("wheel_sigma", 0.005).value)

        self._course = Course()
        self._yard = Yard(seed, self._course)
        self._seed = seed
        self._wheel_noise = np.random.default_rng([seed, 0])
        self._rays, self._offsets = _rays(rings, columns)
        self._began_ns: int | None = None
        self._last_ns = 0
        self._sweep = 0
        self._by_wheels = 0.0

        self._points = self.create_publisher(PointCloud2, "points", qos_profile_sensor_data)
        self._wheels = self.create_publisher(Odometry, "wheel/odom", qos_profile_sensor_data)
        self._truth = self.create_publisher(Odometry, "ground_truth", QoSProfile(depth=10))
        self._finished = self.create_publisher(Empty, "finished", QoSProfile(depth=1))
        self.create_timer(WHEELS_S, self._on_timer)

    def _on_timer(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        if self._began_ns is None:
            self._began_ns = now_ns
        since_ns = now_ns - self._began_ns
        self._publish_wheels(since_ns)
        over = min(since_ns // SWEEP_NS, self._sweeps)
        for sweep in range(self._sweep + 1, over + 1):
            self._publish_sweep(sweep, is_lost=sweep < over)
        self._sweep = over
        if since_ns >= self._sweeps * SWEEP_NS + LAST_WORD_NS:  # the last one has been heard
            self._finished.publish(Empty())

    def _publish_wheels(self, now_ns: int) -> None:
        """Tell how far the wheels have turned and where the gyroscope says the robot looks."""
        places, yaws = self._course.poses(np.array([self._last_ns, now_ns]) / 1e9)
        passed_s = (now_ns - self._last_ns) / 1e9
        self._last_ns = now_ns
        step = float(np.hypot(*(places[1] - places[0])[:2])) * self._wheel_scale
        self._by_wheels += step + self._wheel_noise.normal(0.0, self._wheel_sigma)
        said = self._odometry("wheels", "robot", now_ns, planar(np.zeros(3), float(yaws[1])))
        said.pose.pose.position.x = self._by_wheels
        said.twist.twist.linear.x = step / passed_s if passed_s else 0.0
        self._wheels.publish(said)

    def _publish_sweep(self, sweep: int, *, is_lost: bool) -> None:
        """Publish a sweep, and the pose it ended in; of one that is lost only that."""
        end = sweep * SWEEP_S
        place, yaw = self._course.poses(np.array([end]))
        truth = self._odometry("map", "lidar", sweep * SWEEP_NS, planar(place[0], float(yaw[0])))
        self._truth.publish(truth)
        if is_lost:
            return
        rings = len(self._rays) // len(self._offsets)
        places, yaws = self._course.poses(end - SWEEP_S + self._offsets)
        turned = _turned(self._rays, np.repeat(yaws, rings))
        ranges = self._yard.ranges(np.repeat(places, rings, axis=0), turned)
        noise = np.random.default_rng([self._seed, sweep])
        ranges = ranges + noise.normal(0.0, self._range_sigma, len(ranges))
        seen = (ranges > 0.5) & (ranges < RANGE_MAX)
        points = self._rays[seen] * ranges[seen, None]
        times = np.repeat(self._offsets, rings)[seen]
        self._points.publish(cloud_of("lidar", truth.header.stamp, points, times))

    def _odometry(self, frame_id: str, child: str, at_ns: int, matrix: Array) -> Odometry:
        """Return a pose at a time since the robot began."""
        said = Odometry()
        said.header.stamp = Time(nanoseconds=(self._began_ns or 0) + at_ns).to_msg()
        said.header.frame_id, said.child_frame_id = frame_id, child
        set_pose(said.pose.pose, matrix)
        return said


def _rays(rings: int, columns: int) -> tuple[Array, Array]:
    """Return unit directions in the LiDAR's frame, shape (rings × columns, 3), a column after the
    other, and when in a sweep each column is measured, in seconds, shape (columns,)."""
    offsets = np.arange(columns) / columns * SWEEP_S
    azimuth = np.repeat(-2 * np.pi * np.arange(columns) / columns, rings)
    elevation = np.tile(np.radians(np.linspace(-15.0, 15.0, rings)), columns)
    flat = np.cos(elevation)
    directions = [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)]
    return np.stack(directions, axis=1), offsets


def _turned(rays: Array, yaws: Array) -> Array:
    c, s = np.cos(yaws), np.sin(yaws)
    x = c * rays[:, 0] - s * rays[:, 1]
    y = s * rays[:, 0] + c * rays[:, 1]
    return np.stack([x, y, rays[:, 2]], axis=1)
