"""The planner: a service that returns the way around a course."""

from __future__ import annotations

from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from rclpy.node import Node

from fusion_demo.course import distance, section, smooth_loop
from fusion_demo.ros_math import pose_stamped

DEFAULT_X = [0.0, 5.0, 9.0, 9.5, 6.0, 2.0, -2.5, -3.5]
DEFAULT_Y = [0.0, -0.5, 1.5, 5.5, 7.5, 5.5, 6.0, 2.0]


class Planner(Node):
    """Serves /plan: the part of a smooth loop from near ``start`` to near ``goal``.

    Where both are at one place it is once around. The request's tolerance is how far from the
    loop a start or goal may be (0: any distance); beyond it the plan is empty. Parameters:
    ``waypoints_x``, ``waypoints_y`` [m] and ``spacing`` [m] of the points of a plan.
    """

    def __init__(self) -> None:
        super().__init__("planner")
        xs = self.declare_parameter("waypoints_x", DEFAULT_X).value
        ys = self.declare_parameter("waypoints_y", DEFAULT_Y).value
        spacing = self.declare_parameter("spacing", 0.2).value
        if len(xs) != len(ys):
            raise ValueError(
                f"waypoints_x has {len(xs)} values and waypoints_y {len(ys)}; "
                f"give one of each per waypoint"
            )
        self._loop = smooth_loop(list(zip(xs, ys, strict=True)), spacing)
        self.create_service(GetPlan, "plan", self._on_plan)

    def _on_plan(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        start = request.start.pose.position.x, request.start.pose.position.y
        goal = request.goal.pose.position.x, request.goal.pose.position.y
        plan = Path()
        plan.header.frame_id = "map"
        plan.header.stamp = self.get_clock().now().to_msg()
        response.plan = plan
        for name, point in (("start", start), ("goal", goal)):
            off = min(distance(point, each) for each in self._loop)
            if request.tolerance > 0 and off > request.tolerance:
                self.get_logger().warning(f"no plan: the {name} is {off:.1f} m off the course")
                return response
        points = section(self._loop, start, goal)
        plan.poses = [pose_stamped("map", plan.header.stamp, x, y, 0.0) for x, y in points]
        self.get_logger().info(
            f"plan of {len(points)} points from ({start[0]:.2f}, {start[1]:.2f})"
        )
        return response
