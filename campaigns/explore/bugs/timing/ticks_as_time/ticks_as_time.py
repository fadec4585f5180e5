"""A controller takes the number of its ticks for time, and a slow callback makes it skip some."""

from rclpy.node import Node
from std_msgs.msg import Float64


class Controller(Node):
    """Works a hundred times per second, and says how late its count of time is."""

    def __init__(self):
        super().__init__("controller")
        self.begin = self.get_clock().now()
        self.elapsed = 0.0
        self.publisher = self.create_publisher(Float64, "time_error", 10)
        self.create_timer(0.01, self.tick)

    def since_begin(self):
        return (self.get_clock().now() - self.begin).nanoseconds / 1e9

    def tick(self):
        self.count()
        self.publisher.publish(Float64(data=self.since_begin() - self.elapsed))

    def count(self):
        self.elapsed += 0.01


class ClockController(Controller):
    """Looks at the clock."""

    def count(self):
        self.elapsed = self.since_begin()
