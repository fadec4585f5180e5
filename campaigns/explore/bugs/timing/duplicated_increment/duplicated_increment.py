"""A way is the sum of increments; one that comes twice, or not at all, stays wrong for ever."""

from geometry_msgs.msg import Point
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


class Encoder(Node):
    """Publishes the ticks since the last message (x), and all of them (y)."""

    def __init__(self):
        super().__init__("encoder")
        self.total = 0
        self.publisher = self.create_publisher(Point, "ticks", BEST_EFFORT)
        self.create_timer(0.05, self.tick)

    def tick(self):
        self.total += 3
        self.publisher.publish(Point(x=3.0, y=float(self.total)))


class Odometer(Node):
    """Publishes how far the encoder's count is from its own."""

    def __init__(self):
        super().__init__("odometer")
        self.total = 0
        self.publisher = self.create_publisher(Int32, "error", 10)
        self.create_subscription(Point, "ticks", self.on_ticks, BEST_EFFORT)

    def on_ticks(self, ticks):
        self.count(ticks)
        self.publisher.publish(Int32(data=int(ticks.y) - self.total))

    def count(self, ticks):
        if self.total == 0:
            self.total = int(ticks.y)  # whatever was before we came
        else:
            self.total += int(ticks.x)


class AbsoluteOdometer(Odometer):
    """Goes by the whole count."""

    def count(self, ticks):
        self.total = int(ticks.y)
