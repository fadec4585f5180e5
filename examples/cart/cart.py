"""A cart that drives up to a wall and stops in front of it. One of its three nodes has a bug."""

from rclpy.node import Node
from sensor_msgs.msg import Range
from std_msgs.msg import Bool, Float64


class Wheels(Node):
    """Move the cart, and say where it is."""

    def __init__(self):
        super().__init__("wheels")
        self.position = 0.0
        self.speed = 0.0
        self.create_subscription(Float64, "speed", self.on_speed, 10)
        self.publisher = self.create_publisher(Float64, "position", 10)
        self.create_timer(0.05, self.roll)

    def on_speed(self, message):
        self.speed = message.data

    def roll(self):
        self.position += self.speed * 0.05
        self.publisher.publish(Float64(data=self.position))


class Scanner(Node):
    """Measure how far away the wall is, and warn of it below a metre."""

    def __init__(self):
        super().__init__("scanner")
        self.range = 3.0
        self.create_subscription(Float64, "position", self.on_position, 10)
        self.scans = self.create_publisher(Range, "range", 10)
        self.warnings = self.create_publisher(Bool, "obstacle", 10)
        self.create_timer(0.1, self.scan)

    def on_position(self, message):
        self.range = 3.0 - message.data

    def scan(self):
        self.scans.publish(Range(range=self.range))
        if self.range < 1.0:
            self.warnings.publish(Bool(data=True))


class Driver(Node):
    """Drive until there is an obstacle, and wait until it is gone."""

    def __init__(self):
        super().__init__("driver")
        self.obstacle = False
        self.create_subscription(Bool, "obstacle", self.on_obstacle, 10)
        self.publisher = self.create_publisher(Float64, "speed", 10)
        self.create_timer(0.1, self.drive)

    def on_obstacle(self, message):
        self.obstacle = message.data

    def drive(self):
        self.publisher.publish(Float64(data=0.0 if self.obstacle else 0.5))
        self.obstacle = False  # until the scanner says so again
