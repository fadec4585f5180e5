"""A speed is the way divided by the time that the computer's clock says has passed."""

from geometry_msgs.msg import Point
from rclpy.node import Node
from std_msgs.msg import Float64


class Encoder(Node):
    """Publishes where the wheel is."""

    def __init__(self):
        super().__init__("encoder")
        self.x = 0.0
        self.publisher = self.create_publisher(Point, "wheel", 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.x += 0.05
        self.publisher.publish(Point(x=self.x))


class Speedometer(Node):
    """Publishes how fast the wheel turns."""

    def __init__(self):
        super().__init__("speedometer")
        self.before = None
        self.publisher = self.create_publisher(Float64, "speed", 10)
        self.create_subscription(Point, "wheel", self.on_wheel, 10)

    def on_wheel(self, wheel):
        now = self.get_clock().now().nanoseconds / 1e9
        if self.before is not None:
            then, x = self.before
            self.tell(wheel.x - x, now - then)
        self.before = (now, wheel.x)

    def tell(self, way, seconds):
        self.publisher.publish(Float64(data=way / seconds))


class DoubtingSpeedometer(Speedometer):
    """Does not believe a clock that was set."""

    def tell(self, way, seconds):
        if 0.05 < seconds < 0.15:
            super().tell(way, seconds)
