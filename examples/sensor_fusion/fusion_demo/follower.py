"""The path follower: asks the planner for a lap, drives it, asks for the next."""

from __future__ import annotations

from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from nav_msgs.srv import GetPlan
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future

from fusion_demo.course import Limits, PurePursuit
from fusion_demo.ros_math import yaw_of


class PathFollower(Node):
    """Pure pursuit along a plan, by /odometry/filtered; publishes /cmd_vel at 20 Hz.

    It stands still as long as it has no pose or no plan. Parameters: ``lookahead`` [m], ``speed``
    [m/s], ``sideways_acceleration`` [m/s²], ``yaw_rate`` [rad/s] at most, and ``tolerance`` [m] of
    its requests.
    """

    def __init__(self) -> None:
        super().__init__("follower")
        self._lookahead = self._parameter("lookahead", 1.0)
        self._limits = Limits(
            speed=self._parameter("speed", 1.2),
            sideways=self._parameter("sideways_acceleration", 0.8),
            yaw_rate=self._parameter("yaw_rate", 1.2),
        )
        self._tolerance = self._parameter("tolerance", 3.0)
        self._odometry: Odometry | None = None
        self._pursuit: PurePursuit | None = None
        self._asked = False
        self._laps = 0
        self._lap_start_ns = 0
        self._command = self.create_publisher(Twist, "cmd_vel", QoSProfile(depth=1))
        self._plan = self.create_client(GetPlan, "plan")
        self.create_subscription(
            Odometry, "odometry/filtered", self._on_odometry, QoSProfile(depth=1)
        )
        self.create_timer(0.05, self._on_timer)

    def _parameter(self, name: str, default: float) -> float:
        return float(self.declare_parameter(name, default).value)

    def _on_odometry(self, odometry: Odometry) -> None:
        self._odometry = odometry

    def _on_timer(self) -> None:
        command = Twist()
        if self._odometry is not None:
            pose = self._odometry.pose.pose
            if self._pursuit is None:
                self._ask()
            else:
                command.linear.x, command.angular.z = self._pursuit.command(
                    pose.position.x, pose.position.y, yaw_of(pose.orientation)
                )
                if self._pursuit.finished:
                    self._finish_lap()
        self._command.publish(command)

    def _finish_lap(self) -> None:
        self._pursuit = None
        self._laps += 1
        lap_ns = self.get_clock().now().nanoseconds - self._lap_start_ns
        self.get_logger().info(f"lap {self._laps} done in {lap_ns / 1e9:.2f} s")
        self._ask()

    def _ask(self) -> None:
        """Ask for a lap from here to here, unless an answer is due or nobody would give one."""
        if self._asked or self._odometry is None or not self._plan.service_is_ready():
            return
        request = GetPlan.Request()
        request.start.header = request.goal.header = self._odometry.header
        request.start.pose = request.goal.pose = self._odometry.pose.pose
        request.tolerance = self._tolerance
        self._asked = True
        self._plan.call_async(request).add_done_callback(self._on_plan)

    def _on_plan(self, future: Future) -> None:
        self._asked = False
        poses = future.result().plan.poses
        if not poses:
            return  # the planner has said why; the timer asks again
        path = [(pose.pose.position.x, pose.pose.position.y) for pose in poses]
        self._pursuit = PurePursuit(path, self._lookahead, self._limits)
        self._lap_start_ns = self.get_clock().now().nanoseconds
