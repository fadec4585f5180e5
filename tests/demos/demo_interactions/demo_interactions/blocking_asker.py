"""Asks the adder with calls that block, while a thread spins."""

import threading

import rclpy
from rclpy.executors import MultiThreadedExecutor
from test_msgs.srv import BasicTypes


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    node = rclpy.create_node("blocking_asker")
    executor = MultiThreadedExecutor(num_threads=2)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    client = node.create_client(BasicTypes, "add")
    client.wait_for_service()
    rate = node.create_rate(20.0)
    for number in range(3):
        answer = client.call(BasicTypes.Request(int64_value=100, int32_value=number))
        node.get_logger().info(f"{answer.string_value}={answer.int64_value}")
        rate.sleep()
    node.destroy_rate(rate)
    executor.shutdown()
    thread.join(5.0)
    node.destroy_node()
    rclpy.shutdown()
