"""Feedback comes before the answer to the goal that it is about."""

from rclpy.action import ActionClient, ActionServer
from rclpy.node import Node
from std_msgs.msg import Int32
from test_msgs.action import Fibonacci


class Counting(Node):
    """Says at once how far it is."""

    def __init__(self):
        super().__init__("counting")
        self.server = ActionServer(self, Fibonacci, "count", self.count)

    def count(self, goal):
        goal.publish_feedback(Fibonacci.Feedback(sequence=[1]))
        goal.succeed()
        return Fibonacci.Result(sequence=[1, 2])


class Client(Node):
    """Shows the progress of its goal."""

    def __init__(self):
        super().__init__("client")
        self.goal = None
        self.client = ActionClient(self, Fibonacci, "count")
        self.publisher = self.create_publisher(Int32, "progress", 10)
        self.timer = self.create_timer(0.3, self.begin)

    def begin(self):
        self.timer.cancel()
        future = self.client.send_goal_async(Fibonacci.Goal(), feedback_callback=self.on_feedback)
        future.add_done_callback(self.on_goal)

    def on_goal(self, future):
        self.goal = future.result()

    def on_feedback(self, message):
        if self.goal.accepted:
            self.publisher.publish(Int32(data=len(message.feedback.sequence)))


class EasyClient(Client):
    """Feedback is only sent for accepted goals: there is no need to look."""

    def on_feedback(self, message):
        self.publisher.publish(Int32(data=len(message.feedback.sequence)))
