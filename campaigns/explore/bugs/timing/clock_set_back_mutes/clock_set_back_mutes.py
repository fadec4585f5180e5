"""A filter drops what is older than what it has seen: a clock set back mutes a sensor."""

from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import Range
from std_msgs.msg import Float64


class Sonar(Node):
    """Measures 20 times per second, on a computer with a clock of its own."""

    def __init__(self):
        super().__init__("sonar")
        self.publisher = self.create_publisher(Range, "sonar", 10)
        self.create_timer(0.05, self.tick)

    def tick(self):
        message = Range(range=1.0)
        message.header.stamp = self.get_clock().now().to_msg()
        self.publisher.publish(message)


class Filter(Node):
    """Lets through what is newer than the last."""

    def __init__(self):
        super().__init__("filter")
        self.newest = Time()
        self.publisher = self.create_publisher(Float64, "distance", 10)
        self.create_subscription(Range, "sonar", self.on_range, 10)

    def on_range(self, message):
        stamp = Time.from_msg(message.header.stamp, clock_type=self.newest.clock_type)
        if stamp > self.newest or self.starts_anew(stamp):
            self.newest = stamp
            self.publisher.publish(Float64(data=message.range))

    def starts_anew(self, stamp):
        return False


class ForgivingFilter(Filter):
    """Starts anew where the stamps go back by more than messages overtake each other."""

    def starts_anew(self, stamp):
        return (self.newest - stamp).nanoseconds > 100_000_000
