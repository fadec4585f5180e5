"""KISS-ICP as a node: sweeps in, the way of the LiDAR and a map out."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseStamped
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2

from lidar_demo.clouds import Array, cloud_of, matrix_of, planar, points_of, set_pose


class KissOdometry(Node):
    """Registers each sweep of /points with the map of those before it.

    Publishes /odom, the sweep in the frame of the map (/registered), and with every tenth sweep the
    whole /path and the /local_map. Where /wheel/odom is heard, what the wheels said since the last
    sweep is where the search for the next pose begins; otherwise KISS-ICP takes the speed to be
    that of the last sweep.

    Parameters: ``initial_pose`` in the frame ``map``: x, y, z [m] and yaw [rad]; ``max_range``,
    ``voxel_size`` [m]; ``queue``: how many sweeps wait, at most, while
    one is registered; ``max_num_threads`` of KISS-ICP (0: as many as TBB likes).
    """

    def __init__(self) -> None:
        super().__init__("odometry")
        config = KISSConfig()
        config.data.max_range = float(self.declare_parameter("max_range", 50.0).value)
        config.data.min_range = 0.5
        config.mapping.voxel_size = float(self.declare_parameter("voxel_size", 0.8).value)
        threads = int(self.declare_parameter("max_num_threads", 0).value)
        config.registration.max_num_threads = threads
        self._icp = KissICP(config)
        x, y, z, yaw = self.declare_parameter("initial_pose", [0.0, 0.0, 0.0, 0.0]).value
        self._icp.last_pose = planar(np.array([x, y, z]), yaw)
        self._path = Path()
        self._path.header.frame_id = "map"
        self._by_wheels: Array | None = None
        self._at_last_sweep: Array | None = None
        self._sweeps = 0

        self._odom = self.create_publisher(Odometry, "odom", QoSProfile(depth=10))
        self._registered = self.create_publisher(PointCloud2, "registered", QoSProfile(depth=1))
        self._ways = self.create_publisher(Path, "path", QoSProfile(depth=1))
        self._map = self.create_publisher(PointCloud2, "local_map", QoSProfile(depth=1))
        queue = int(self.declare_parameter("queue", 2).value)
        newest = QoSProfile(depth=queue, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(PointCloud2, "points", self._on_points, newest)
        self.create_subscription(Odometry, "wheel/odom", self._on_wheels, qos_profile_sensor_data)

    def _on_wheels(self, said: Odometry) -> None:
        """Remember where the wheels are now: how far they have come, and where the robot looks."""
        self._by_wheels = matrix_of(said.pose.pose)

    def _on_points(self, cloud: PointCloud2) -> None:
        points, times = points_of(cloud)
        self._expect()
        sweep, _ = self._icp.register_frame(points, times)
        self._sweeps += 1
        self._publish(cloud, sweep, self._icp.last_pose)

    def _expect(self) -> None:
        """Let the search begin where the wheels say that the robot is."""
        now, before = self._by_wheels, self._at_last_sweep
        if now is not None and before is not None:
            moved = np.eye(4)
            moved[:3, :3] = before[:3, :3].T @ now[:3, :3]
            moved[0, 3] = now[0, 3] - before[0, 3]  # straight ahead, as far as the wheels turned
            self._icp.last_delta = moved
        self._at_last_sweep = now

    def _publish(self, cloud: PointCloud2, sweep: Array, pose: Array) -> None:
        odom = Odometry()
        odom.header.stamp = cloud.header.stamp
        odom.header.frame_id, odom.child_frame_id = "map", cloud.header.frame_id
        set_pose(odom.pose.pose, pose)
        self._odom.publish(odom)
        placed = sweep @ pose[:3, :3].T + pose[:3, 3]
        self._registered.publish(cloud_of("map", cloud.header.stamp, placed))
        self._path.poses.append(PoseStamped(header=odom.header, pose=odom.pose.pose))
        if self._sweeps % 10 == 0:
            self._path.header.stamp = cloud.header.stamp
            self._ways.publish(self._path)
            points = self._icp.local_map.point_cloud()
            self._map.publish(cloud_of("map", cloud.header.stamp, points))
