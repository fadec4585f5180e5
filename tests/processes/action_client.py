"""Sends three goals: one is rejected, one succeeds, one is cancelled. Says on /said what comes."""

import rclpy
from rclpy.action import ActionClient
from rclpy.node import Node
from std_msgs.msg import String
from test_msgs.action import Fibonacci


class Client(Node):
    def __init__(self):
        super().__init__("client")
        self.client = ActionClient(self, Fibonacci, "count")
        self.said = self.create_publisher(String, "said", 10)
        self.start = self.create_timer(0.25, self.begin)

    def say(self, *words):
        self.said.publish(String(data=" ".join(map(str, words))))

    def begin(self):
        self.start.cancel()
        self.say("server", self.client.server_is_ready())
        for order in (-1, 3, 30):
            self.client.send_goal_async(
                Fibonacci.Goal(order=order),
                feedback_callback=lambda told, order=order: self.say(
                    order, "feedback", list(told.feedback.sequence)
                ),
            ).add_done_callback(lambda future, order=order: self.answered(order, future.result()))

    def answered(self, order, goal):
        self.say(order, "accepted", goal.accepted)
        if not goal.accepted:
            return
        goal.get_result_async().add_done_callback(
            lambda future: self.say(
                order, "result", future.result().status, list(future.result().result.sequence)
            )
        )
        if order == 30:
            self.end = self.create_timer(0.4, lambda: self.cancel(goal))

    def cancel(self, goal):
        self.end.cancel()
        goal.cancel_goal_async().add_done_callback(
            lambda future: self.say("cancelling", len(future.result().goals_canceling))
        )


def main():
    rclpy.init()
    rclpy.spin(Client())


if __name__ == "__main__":
    main()
