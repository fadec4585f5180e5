"""A service that counts how often it was asked."""

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from test_msgs.srv import BasicTypes


class Adder(Node):
    """Serves /add: the sum of two numbers of the request."""

    def __init__(self):
        super().__init__("adder")
        self.create_service(BasicTypes, "add", self.add)

    def add(self, request, response):
        """Answer."""
        response.int64_value = request.int64_value + request.int32_value
        response.string_value = f"{request.int64_value}+{request.int32_value}"
        return response


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    try:
        rclpy.spin(Adder())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
