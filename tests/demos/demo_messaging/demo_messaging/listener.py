"""Listens until it has heard ten messages, and says how many letters those were."""

import rclpy
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import String


class Listener(Node):
    """Subscribes to /chatter."""

    def __init__(self):
        super().__init__("listener")
        self.heard = []
        self.done = Future()
        self.create_subscription(String, "chatter", self.hear, 10)

    def hear(self, message):
        """Take down a message."""
        self.get_logger().info(f"I heard: [{message.data}]")
        self.heard.append(message.data)
        if len(self.heard) == 10:
            self.done.set_result(sum(map(len, self.heard)))


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    node = Listener()
    rclpy.spin_until_future_complete(node, node.done)
    node.get_logger().info(f"{node.done.result()} letters")
    node.destroy_node()
    rclpy.shutdown()
