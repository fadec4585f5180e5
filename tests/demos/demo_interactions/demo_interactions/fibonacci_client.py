"""Sends three goals: one that is too much, one to the end, and one that it takes back."""

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.node import Node
from test_msgs.action import Fibonacci

NAMES = {value: name for name, value in vars(GoalStatus).items() if name.startswith("STATUS_")}


class FibonacciClient(Node):
    """A client of /fibonacci."""

    def __init__(self):
        super().__init__("fibonacci_client")
        self.client = ActionClient(self, Fibonacci, "fibonacci")
        self.feedback = []

    def wait_for(self, future):
        """Spin until the future is done; return its result."""
        rclpy.spin_until_future_complete(self, future)
        return future.result()

    def attempt(self, order, *, cancel_after=None):
        """Send a goal and see what becomes of it."""
        self.feedback.clear()
        goal = self.wait_for(
            self.client.send_goal_async(
                Fibonacci.Goal(order=order),
                feedback_callback=lambda m: self.feedback.append(list(m.feedback.sequence)),
            )
        )
        if not goal.accepted:
            self.get_logger().info(f"{order}: rejected")
            return
        result = goal.get_result_async()
        if cancel_after is not None:
            while len(self.feedback) < cancel_after:
                rclpy.spin_once(self, timeout_sec=1.0)
            answer = self.wait_for(goal.cancel_goal_async())
            self.get_logger().info(f"{order}: {len(answer.goals_canceling)} to be cancelled")
        done = self.wait_for(result)
        status = NAMES[done.status].removeprefix("STATUS_").lower()
        self.get_logger().info(f"{order}: {status} {list(done.result.sequence)}")
        if cancel_after is None:
            self.get_logger().info(f"{order}: feedback {self.feedback}")


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    node = FibonacciClient()
    if not node.client.wait_for_server(timeout_sec=300.0):
        raise SystemExit("there is no action server")
    node.attempt(99)
    node.attempt(5)
    node.attempt(9, cancel_after=2)
    node.client.destroy()
    node.destroy_node()
    rclpy.shutdown()
