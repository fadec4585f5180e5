"""The EKF as a node: sensors in, a pose with its covariance out."""

from __future__ import annotations

import math

from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus

from fusion_demo.alignment import TrackAligner
from fusion_demo.ekf import YAW, Ekf, V, W, X, Y
from fusion_demo.geodesy import LocalFrame
from fusion_demo.ros_math import YawRate, pose_of, pose_stamped, stamp_ns

# Where the state variables stand in a 6x6 covariance of ROS, for pose and for twist.
POSE_INDICES = ((X, 0), (Y, 1), (YAW, 5))
TWIST_INDICES = ((V, 0), (W, 5))


class EkfNode(Node):
    """Fuses /wheel/odom (speed and yaw rate), /imu/data (yaw rate) and /fix (position).

    The map frame is the plane that touches the Earth at the datum, x east and y north. Parameters:

    - ``datum_latitude``, ``datum_longitude`` in degrees; not a number: where the first fix is.
    - ``initial_pose``: x, y [m] and yaw [rad] in the map.
    - ``align_distance``: metres to drive before the heading is known, which is then found by
      laying odometry on GPS, and nothing is published before; 0: ``initial_pose`` is right.
    - ``imu_mount``: roll, pitch, yaw [rad] of the IMU on the robot.
    - ``speed_sigma`` [m/s], ``wheel_yaw_rate_sigma``, ``gyro_sigma`` [rad/s]: how far to trust
      the sensors; ``fix_sigma_min`` [m]: no fix is trusted more than this, whatever it says.
    - ``fix_gate``: fixes more standard deviations away than this are refused.
    - ``path_length_max``: poses kept in the path.
    """

    def __init__(self) -> None:
        super().__init__("ekf")
        self._latitude = self._parameter("datum_latitude", math.nan)
        self._longitude = self._parameter("datum_longitude", math.nan)
        x, y, yaw = self.declare_parameter("initial_pose", [0.0, 0.0, 0.0]).value
        roll, pitch, mount_yaw = self.declare_parameter("imu_mount", [0.0, 0.0, 0.0]).value
        align_distance = self._parameter("align_distance", 0.0)
        self._speed_variance = self._parameter("speed_sigma", 0.05) ** 2
        self._wheel_yaw_rate_variance = self._parameter("wheel_yaw_rate_sigma", 0.1) ** 2
        self._gyro_variance = self._parameter("gyro_sigma", 0.02) ** 2
        self._fix_variance_min = self._parameter("fix_sigma_min", 0.5) ** 2
        self._fix_gate = self._parameter("fix_gate", 5.0)
        self._path_length_max = int(self.declare_parameter("path_length_max", 200).value)

        self._frame: LocalFrame | None = None
        if not math.isnan(self._latitude) and not math.isnan(self._longitude):
            self._frame = LocalFrame(self._latitude, self._longitude)
        self._aligner = TrackAligner(align_distance) if align_distance > 0 else None
        self._yaw_rate = YawRate(roll, pitch, mount_yaw)
        self._ekf = Ekf()
        self._ekf.set_pose(x, y, yaw)
        self._fixes_refused = 0

        self._path = Path()
        self._path.header.frame_id = "map"
        self._odometry_publisher = self.create_publisher(
            Odometry, "odometry/filtered", QoSProfile(depth=10)
        )
        self._path_publisher = self.create_publisher(Path, "path", QoSProfile(depth=1))
        self.create_subscription(Imu, "imu/data", self._on_imu, qos_profile_sensor_data)
        self.create_subscription(Odometry, "wheel/odom", self._on_odometry, QoSProfile(depth=10))
        self.create_subscription(NavSatFix, "fix", self._on_fix, qos_profile_sensor_data)
        self.create_timer(1.0, self._on_timer)

    def _parameter(self, name: str, default: float) -> float:
        return float(self.declare_parameter(name, default).value)

    def _on_imu(self, imu: Imu) -> None:
        self._ekf.advance(stamp_ns(imu.header.stamp))
        self._ekf.update_yaw_rate(self._yaw_rate.of(imu.angular_velocity), self._gyro_variance)

    def _on_odometry(self, odometry: Odometry) -> None:
        self._ekf.advance(stamp_ns(odometry.header.stamp))
        twist = odometry.twist.twist
        self._ekf.update_speed(twist.linear.x, self._speed_variance)
        self._ekf.update_yaw_rate(twist.angular.z, self._wheel_yaw_rate_variance)
        if self._aligner is None:
            self._publish(odometry)

    def _on_fix(self, fix: NavSatFix) -> None:
        if fix.status.status == NavSatStatus.STATUS_NO_FIX:
            return
        if self._frame is None:
            self._frame = LocalFrame(fix.latitude, fix.longitude)
        self._ekf.advance(stamp_ns(fix.header.stamp))
        east, north = self._frame.to_metres(fix.latitude, fix.longitude)
        claimed = max(map(float, fix.position_covariance[:5:4]))
        if self._aligner is not None:
            self._align(self._aligner, (east, north), claimed)
        elif not self._ekf.update_position(
            east, north, max(claimed, self._fix_variance_min), self._fix_gate
        ):
            self._fixes_refused += 1
            self.get_logger().warning(
                f"fix refused, it is {east - self._ekf.state[X]:.1f} m east and "
                f"{north - self._ekf.state[Y]:.1f} m north of the filter "
                f"({self._fixes_refused} so far)"
            )

    def _align(self, aligner: TrackAligner, world: tuple[float, float], variance: float) -> None:
        local = float(self._ekf.state[X]), float(self._ekf.state[Y])
        found = aligner.add(local, world, variance)
        if found is not None:
            self._ekf.move_frame(found.turn, found.x, found.y, found.variance)
            self._aligner = None
            self.get_logger().info(
                f"heading found: {math.degrees(float(self._ekf.state[YAW])):.1f}° "
                f"± {math.degrees(math.sqrt(found.variance)):.1f}°"
            )

    def _publish(self, cause: Odometry) -> None:
        state, covariance = self._ekf.state, self._ekf.covariance
        odometry = Odometry()
        odometry.header.frame_id = "map"
        odometry.header.stamp = cause.header.stamp
        odometry.child_frame_id = "base_link"
        odometry.pose.pose = pose_of(float(state[X]), float(state[Y]), float(state[YAW]))
        odometry.twist.twist.linear.x = float(state[V])
        odometry.twist.twist.angular.z = float(state[W])
        for target, indices in (
            (odometry.pose.covariance, POSE_INDICES),
            (odometry.twist.covariance, TWIST_INDICES),
        ):
            for row, ros_row in indices:
                for column, ros_column in indices:
                    target[6 * ros_row + ros_column] = covariance[row, column]
        self._odometry_publisher.publish(odometry)

    def _on_timer(self) -> None:
        if self._aligner is not None or self._ekf.stamp_ns is None:
            return
        state = self._ekf.state
        self._path.header.stamp = self.get_clock().now().to_msg()
        self._path.poses.append(
            pose_stamped(
                "map", self._path.header.stamp, float(state[X]), float(state[Y]), float(state[YAW])
            )
        )
        del self._path.poses[: -self._path_length_max]
        self._path_publisher.publish(self._path)
