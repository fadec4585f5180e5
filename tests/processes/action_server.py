"""An action server that goes on by a timer: it counts up to the order of a goal."""

import rclpy
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.node import Node
from rclpy.task import Future
from test_msgs.action import Fibonacci


class Server(Node):
    def __init__(self):
        super().__init__("server")
        self.waiting = []
        self.create_timer(0.1, self.tick)
        self.server = ActionServer(
            self,
            Fibonacci,
            "count",
            self.execute,
            goal_callback=lambda goal: (
                GoalResponse.ACCEPT if goal.order >= 0 else GoalResponse.REJECT
            ),
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )

    def tick(self):
        waiting, self.waiting = self.waiting, []
        for future in waiting:
            future.set_result(None)

    async def execute(self, goal):
        counted = Fibonacci.Feedback()
        for number in range(goal.request.order):
            self.waiting.append(Future())
            await self.waiting[-1]
            if goal.is_cancel_requested:
                goal.canceled()
                return Fibonacci.Result(sequence=counted.sequence)
            counted.sequence.append(number)
            goal.publish_feedback(counted)
        goal.succeed()
        return Fibonacci.Result(sequence=counted.sequence)


def main():
    rclpy.init()
    rclpy.spin(Server())


if __name__ == "__main__":
    main()
