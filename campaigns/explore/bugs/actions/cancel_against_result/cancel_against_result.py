"""A goal is cancelled at the moment at which it is reached."""

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Empty, String
from test_msgs.action import Fibonacci


class Navigation(Node):
    """Needs 200 ms to a goal."""

    def __init__(self):
        super().__init__("navigation")
        self.server = ActionServer(
            self,
            Fibonacci,
            "navigate",
            self.navigate,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )

    async def navigate(self, goal):
        arrived = Future()
        timer = self.create_timer(0.2, lambda: arrived.set_result(True))
        await arrived
        timer.cancel()
        if goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.succeed()
        return Fibonacci.Result()


class Obstacle(Node):
    """Shows up after half a second."""

    def __init__(self):
        super().__init__("obstacle")
        self.publisher = self.create_publisher(Empty, "obstacle", 10)
        self.timer = self.create_timer(0.5, self.appear)

    def appear(self):
        self.timer.cancel()
        self.publisher.publish(Empty())


class Mission(Node):
    """Drives, and drives back where something is in the way."""

    def __init__(self):
        super().__init__("mission")
        self.goal = None
        self.client = ActionClient(self, Fibonacci, "navigate")
        self.publisher = self.create_publisher(String, "outcome", 10)
        self.create_subscription(Empty, "obstacle", self.on_obstacle, 10)
        self.timer = self.create_timer(0.3, self.begin)

    def begin(self):
        self.timer.cancel()
        self.client.send_goal_async(Fibonacci.Goal()).add_done_callback(self.on_goal)

    def on_goal(self, future):
        self.goal = future.result()
        self.goal.get_result_async().add_done_callback(self.on_result)

    def on_obstacle(self, message):
        self.goal.cancel_goal_async().add_done_callback(self.on_cancelled)

    def on_cancelled(self, future):
        self.tell_cancelled(future.result().goals_canceling)

    def tell_cancelled(self, goals):
        stamp = goals[0].stamp  # of the goal that we have cancelled
        self.publisher.publish(String(data=f"cancelled a goal of {stamp.sec} s"))

    def on_result(self, future):
        if future.result().status == GoalStatus.STATUS_SUCCEEDED:
            self.publisher.publish(String(data="arrived"))


class PreparedMission(Mission):
    """Knows that it may be too late to cancel."""

    def tell_cancelled(self, goals):
        if goals:
            super().tell_cancelled(goals)
