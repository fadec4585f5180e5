"""A base drives as it was told last, also when nobody tells it anything any more."""

from geometry_msgs.msg import Twist
from rclpy.node import Node
from std_msgs.msg import Float64


class Planner(Node):
    """Commands a speed ten times per second."""

    def __init__(self):
        super().__init__("planner")
        self.publisher = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        command = Twist()
        command.linear.x = 1.0
        self.publisher.publish(command)


class Base(Node):
    """Drives, and says how far it has driven since it was told to."""

    def __init__(self):
        super().__init__("base")
        self.speed = 0.0
        self.unattended = 0.0
        self.publisher = self.create_publisher(Float64, "unattended", 10)
        self.create_subscription(Twist, "cmd_vel", self.on_command, 10)
        self.create_timer(0.05, self.tick)

    def on_command(self, command):
        self.speed = command.linear.x
        self.unattended = 0.0

    def tick(self):
        self.unattended += self.speed * 0.05
        self.publisher.publish(Float64(data=self.unattended))


class WatchfulBase(Base):
    """Stops when it has not been told anything for a while."""

    def tick(self):
        if self.unattended > 0.3:
            self.speed = 0.0
        super().tick()
