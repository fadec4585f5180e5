"""Waits for somebody to listen, then says hello ten times a second until it is stopped."""

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String


class Talker(Node):
    """Publishes on /chatter."""

    def __init__(self):
        super().__init__("talker")
        self.publisher = self.create_publisher(String, "chatter", 10)
        self.count = 0

    def start(self):
        """Begin to talk."""
        self.timer = self.create_timer(0.1, self.say)

    def say(self):
        """Say hello once."""
        self.count += 1
        if self.count <= 10:
            self.get_logger().info(f"Publishing: 'Hello World: {self.count}'")
            self.publisher.publish(String(data=f"Hello World: {self.count}"))


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    node = Talker()
    try:
        while node.publisher.get_subscription_count() == 0:
            rclpy.spin_once(node, timeout_sec=0.1)
        node.start()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
