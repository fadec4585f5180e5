"""A route comes back after the operator has stopped the robot, and sets it going again."""

from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan
from rclpy.node import Node
from std_msgs.msg import Bool, Empty


class Operator(Node):
    """Sets a goal, and stops the robot 20 ms later."""

    def __init__(self):
        super().__init__("operator")
        self.goals = self.create_publisher(PoseStamped, "goal", 10)
        self.stops = self.create_publisher(Empty, "stop", 10)
        self.timer = self.create_timer(0.5, self.start)

    def start(self):
        self.timer.cancel()
        self.goals.publish(PoseStamped())
        self.stop_timer = self.create_timer(0.02, self.stop)

    def stop(self):
        self.stop_timer.cancel()
        self.stops.publish(Empty())


class Planner(Node):
    """Plans routes."""

    def __init__(self):
        super().__init__("planner")
        self.create_service(GetPlan, "plan", lambda request, response: response)


class Navigator(Node):
    """Drives as soon as there is a route."""

    def __init__(self):
        super().__init__("navigator")
        self.driving = False
        self.goal = None
        self.client = self.create_client(GetPlan, "plan")
        self.publisher = self.create_publisher(Bool, "driving", 10)
        self.create_subscription(PoseStamped, "goal", self.on_goal, 10)
        self.create_subscription(Empty, "stop", self.on_stop, 10)
        self.create_timer(0.1, lambda: self.publisher.publish(Bool(data=self.driving)))

    def on_goal(self, goal):
        self.goal = goal
        request = GetPlan.Request(goal=goal)
        self.client.call_async(request).add_done_callback(lambda done: self.on_route(goal))

    def on_stop(self, message):
        self.goal = None
        self.driving = False

    def on_route(self, goal):
        self.driving = True


class AskingNavigator(Navigator):
    """Looks whether the goal is still the one that was asked for."""

    def on_route(self, goal):
        if goal is self.goal:
            super().on_route(goal)
