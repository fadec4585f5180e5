"""Robots pass a door one at a time; one that dies in it keeps it."""

from rclpy.node import Node
from std_msgs.msg import Int32
from std_srvs.srv import Trigger


class Door(Node):
    """Belongs to one at a time."""

    def __init__(self):
        super().__init__("door")
        self.taken = None
        self.create_service(Trigger, "take", self.take)
        self.create_service(Trigger, "leave", self.leave)

    def is_taken(self):
        return self.taken is not None

    def take(self, request, response):
        response.success = not self.is_taken()
        if response.success:
            self.taken = self.get_clock().now()
        return response

    def leave(self, request, response):
        self.taken = None
        return response


class LeasedDoor(Door):
    """Takes back what was not left for half a second."""

    def is_taken(self):
        if self.taken is None:
            return False
        return (self.get_clock().now() - self.taken).nanoseconds < 500_000_000


class Robot(Node):
    """Passes the door again and again."""

    def __init__(self):
        super().__init__("robot")
        self.take = self.create_client(Trigger, "take")
        self.leave = self.create_client(Trigger, "leave")
        self.publisher = self.create_publisher(Int32, "~/passed", 10)
        self.ask_timer = self.create_timer(0.05, self.ask)
        self.pass_timer = self.create_timer(0.1, self.passed)
        self.pass_timer.cancel()

    def ask(self):
        self.ask_timer.cancel()
        self.take.call_async(Trigger.Request()).add_done_callback(self.on_answer)

    def on_answer(self, future):
        (self.pass_timer if future.result().success else self.ask_timer).reset()

    def passed(self):
        self.pass_timer.cancel()
        self.leave.call_async(Trigger.Request())
        self.publisher.publish(Int32(data=1))
        self.ask_timer.reset()
