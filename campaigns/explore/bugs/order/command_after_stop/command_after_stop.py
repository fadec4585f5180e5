"""A base obeys the last message: a command that was under way undoes the stop."""

from geometry_msgs.msg import Twist
from rclpy.node import Node
from std_msgs.msg import Empty, Float64


class Planner(Node):
    """Commands a speed until it hears of the stop."""

    def __init__(self):
        super().__init__("planner")
        self.publisher = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_subscription(Empty, "stop", self.on_stop, 10)
        self.timer = self.create_timer(0.1, self.tick)

    def on_stop(self, message):
        self.timer.cancel()

    def tick(self):
        command = Twist()
        command.linear.x = 0.5
        self.publisher.publish(command)


class Button(Node):
    """Is pressed after half a second."""

    def __init__(self):
        super().__init__("button")
        self.publisher = self.create_publisher(Empty, "stop", 10)
        self.timer = self.create_timer(0.5, self.press)

    def press(self):
        self.timer.cancel()
        self.publisher.publish(Empty())


class Base(Node):
    """Drives."""

    def __init__(self):
        super().__init__("base")
        self.speed = 0.0
        self.publisher = self.create_publisher(Float64, "speed", 10)
        self.create_subscription(Twist, "cmd_vel", self.on_command, 10)
        self.create_subscription(Empty, "stop", self.on_stop, 10)
        self.create_timer(0.03, lambda: self.publisher.publish(Float64(data=self.speed)))

    def on_command(self, command):
        self.speed = command.linear.x

    def on_stop(self, message):
        self.speed = 0.0


class LatchingBase(Base):
    """Does not go on after a stop."""

    stopped = False

    def on_command(self, command):
        if not self.stopped:
            super().on_command(command)

    def on_stop(self, message):
        self.stopped = True
        super().on_stop(message)
