"""The simulated robot: a unicycle that obeys /cmd_vel, and what its sensors say about it."""

from __future__ import annotations

import math

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus

from fusion_demo.geodesy import LocalFrame
from fusion_demo.ros_math import pose_of
from fusion_demo.unicycle import Unicycle

GRAVITY = 9.80665
UNKNOWN = -1.0
"""First element of a covariance in sensor_msgs/Imu: the sensor does not measure this at all."""


class SimulatedRobot(Node):
    """Publishes /imu/data at 100 Hz, /wheel/odom and /ground_truth at 20 Hz and /fix at 5 Hz.

    Parameters: ``seed`` of the noise; ``datum_latitude``, ``datum_longitude`` [degrees];
    ``gyro_sigma`` and ``gyro_bias`` [rad/s]; ``speed_sigma`` [m/s], ``wheel_scale`` (1.02: wheels
    that claim 2 % too much); ``fix_sigma`` [m].
    """

    def __init__(self) -> None:
        super().__init__("robot")
        seed = self.declare_parameter("seed", 1).value
        # A stream per sensor: adding a sample to one does not change what the others draw.
        self._imu_noise, self._wheel_noise, self._fix_noise = (
            np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3)
        )
        self._frame = LocalFrame(
            self._parameter("datum_latitude", 47.0), self._parameter("datum_longitude", 8.0)
        )
        self._gyro_sigma = self._parameter("gyro_sigma", 0.01)
        self._gyro_bias = self._parameter("gyro_bias", 0.003)
        self._speed_sigma = self._parameter("speed_sigma", 0.02)
        self._wheel_scale = self._parameter("wheel_scale", 1.02)
        self._fix_sigma = self._parameter("fix_sigma", 0.6)

        self._body = Unicycle(0.0, 0.0, 0.0)
        self._by_wheels = Unicycle(0.0, 0.0, 0.0, lag=1e-6)  # where the wheels think it is
        self._command = Twist()
        self._last_ns = self.get_clock().now().nanoseconds
        self._last_wheels_ns = self._last_ns

        self._imu = self.create_publisher(Imu, "imu/data", qos_profile_sensor_data)
        self._wheels = self.create_publisher(Odometry, "wheel/odom", QoSProfile(depth=10))
        self._truth = self.create_publisher(Odometry, "ground_truth", QoSProfile(depth=10))
        self._fix = self.create_publisher(NavSatFix, "fix", qos_profile_sensor_data)
        self.create_subscription(Twist, "cmd_vel", self._on_command, QoSProfile(depth=1))
        self.create_timer(0.01, self._on_imu_timer)
        self.create_timer(0.05, self._on_wheel_timer)
        self.create_timer(0.2, self._on_fix_timer)

    def _parameter(self, name: str, default: float) -> float:
        return float(self.declare_parameter(name, default).value)

    def _on_command(self, command: Twist) -> None:
        self._move()
        self._command = command

    def _move(self) -> None:
        """Bring the body to the present."""
        now_ns = self.get_clock().now().nanoseconds
        dt = (now_ns - self._last_ns) * 1e-9
        self._last_ns = now_ns
        self._body.step(dt, self._command.linear.x, self._command.angular.z)

    def _on_imu_timer(self) -> None:
        self._move()
        turn, forward, sideways, up = self._imu_noise.normal(0.0, self._gyro_sigma, 4)
        body = self._body
        imu = Imu()
        imu.header.stamp = self.get_clock().now().to_msg()
        imu.header.frame_id = "imu_link"
        imu.orientation_covariance[0] = UNKNOWN
        imu.angular_velocity.z = body.yaw_rate + self._gyro_bias + float(turn)
        imu.angular_velocity_covariance[8] = self._gyro_sigma**2
        # An accelerometer is about ten times as noisy as a gyro, in its own unit.
        imu.linear_acceleration.x = body.acceleration + 10 * float(forward)
        imu.linear_acceleration.y = body.speed * body.yaw_rate + 10 * float(sideways)
        imu.linear_acceleration.z = GRAVITY + 10 * float(up)
        imu.linear_acceleration_covariance[::4] = [(10 * self._gyro_sigma) ** 2] * 3
        self._imu.publish(imu)

    def _on_wheel_timer(self) -> None:
        self._move()
        body, wheels = self._body, self._by_wheels
        speed_noise, turn_noise = self._wheel_noise.normal(0.0, self._speed_sigma, 2)
        dt = (self._last_ns - self._last_wheels_ns) * 1e-9
        self._last_wheels_ns = self._last_ns
        speed = self._wheel_scale * body.speed + float(speed_noise)
        wheels.step(dt, speed, self._wheel_scale * body.yaw_rate + 2 * float(turn_noise))
        self._wheels.publish(self._odometry(wheels, "odom"))
        self._truth.publish(self._odometry(body, "map"))

    def _odometry(self, vehicle: Unicycle, frame_id: str) -> Odometry:
        odometry = Odometry()
        odometry.header.stamp = self.get_clock().now().to_msg()
        odometry.header.frame_id = frame_id
        odometry.child_frame_id = "base_link"
        odometry.pose.pose = pose_of(vehicle.x, vehicle.y, vehicle.yaw)
        odometry.twist.twist.linear.x = vehicle.speed
        odometry.twist.twist.angular.z = vehicle.yaw_rate
        odometry.twist.covariance[0] = self._speed_sigma**2
        odometry.twist.covariance[35] = (2 * self._speed_sigma) ** 2
        return odometry

    def _on_fix_timer(self) -> None:
        self._move()
        east, north, up = self._fix_noise.normal(0.0, self._fix_sigma, 3)
        fix = NavSatFix()
        fix.header.stamp = self.get_clock().now().to_msg()
        fix.header.frame_id = "gps"
        fix.status.status = NavSatStatus.STATUS_FIX
        fix.status.service = NavSatStatus.SERVICE_GPS
        fix.latitude, fix.longitude = self._frame.to_degrees(
            self._body.x + float(east), self._body.y + float(north)
        )
        fix.altitude = 2 * float(up)
        variance = math.pow(self._fix_sigma, 2)
        fix.position_covariance[::4] = [variance, variance, 4 * variance]
        fix.position_covariance_type = NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
        self._fix.publish(fix)
