"""An action server that takes its time, can be cancelled, and refuses what is too much."""

import time

import rclpy
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from test_msgs.action import Fibonacci


class FibonacciServer(Node):
    """Serves the action /fibonacci."""

    def __init__(self):
        super().__init__("fibonacci_server")
        self.server = ActionServer(
            self,
            Fibonacci,
            "fibonacci",
            execute_callback=self.execute,
            goal_callback=self.decide,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def decide(self, request):
        """Accept orders up to ten."""
        self.get_logger().info(f"asked for {request.order}")
        return GoalResponse.ACCEPT if request.order <= 10 else GoalResponse.REJECT

    def execute(self, goal):
        """Work for a fifth of a second per number."""
        numbers = [0, 1]
        for _ in range(1, goal.request.order):
            time.sleep(0.2)
            if goal.is_cancel_requested:
                goal.canceled()
                self.get_logger().info("cancelled")
                return Fibonacci.Result()
            numbers.append(numbers[-1] + numbers[-2])
            goal.publish_feedback(Fibonacci.Feedback(sequence=numbers))
        time.sleep(0.2)
        goal.succeed()
        self.get_logger().info(f"done: {numbers}")
        return Fibonacci.Result(sequence=numbers)


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    node = FibonacciServer()
    try:
        rclpy.spin(node, executor=MultiThreadedExecutor())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.server.destroy()
        node.destroy_node()
