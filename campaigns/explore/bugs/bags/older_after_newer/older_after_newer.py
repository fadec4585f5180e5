"""A filter predicts from the stamp of one pose to the next, and trusts that time goes on."""

from geometry_msgs.msg import PointStamped
from rclpy.node import Node
from std_msgs.msg import Float64


class Tracker(Node):
    """Tells where something is; what is recorded of it is the bag that plays."""

    def __init__(self):
        super().__init__("tracker")
        self.publisher = self.create_publisher(PointStamped, "point", 10)
        self.create_timer(0.05, self.tick)

    def tick(self):
        message = PointStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.point.x = 0.5 * message.header.stamp.nanosec / 1e9
        self.publisher.publish(message)


class Filter(Node):
    """Publishes how far in seconds each prediction goes."""

    def __init__(self):
        super().__init__("filter")
        self.last = None
        self.publisher = self.create_publisher(Float64, "step", 10)
        self.create_subscription(PointStamped, "point", self.on_point, 10)

    def on_point(self, message):
        stamp = message.header.stamp.sec + message.header.stamp.nanosec / 1e9
        if self.last is not None:
            step = stamp - self.last
            if not self.takes(step):
                return
            self.publisher.publish(Float64(data=step))
        self.last = stamp

    def takes(self, step):
        return True


class OrderedFilter(Filter):
    """Leaves out what is older than what it has."""

    def takes(self, step):
        return step >= 0
