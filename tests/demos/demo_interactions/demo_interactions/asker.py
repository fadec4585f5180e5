"""Asks the adder, one question after the other, without blocking."""

import rclpy
from test_msgs.srv import BasicTypes


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    node = rclpy.create_node("asker")
    client = node.create_client(BasicTypes, "add")
    while not client.wait_for_service(timeout_sec=1.0):
        node.get_logger().debug("service not available, waiting again...")
    total = 0
    for number in range(5):
        request = BasicTypes.Request(int64_value=total, int32_value=number)
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=300.0)
        answer = future.result()
        node.get_logger().info(f"{answer.string_value}={answer.int64_value}")
        total = answer.int64_value
    node.destroy_node()
    rclpy.shutdown()
