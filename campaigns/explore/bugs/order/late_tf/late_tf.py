"""A mapper looks up where the robot was when the scan was taken, as with a TF buffer."""

from collections import deque

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.time import Duration, Time
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Int32


class Localizer(Node):
    """Publishes the robot's pose 20 times per second."""

    def __init__(self):
        super().__init__("localizer")
        self.publisher = self.create_publisher(TransformStamped, "tf", 10)
        self.create_timer(0.05, self.tick)

    def tick(self):
        transform = TransformStamped()
        transform.header.stamp = self.get_clock().now().to_msg()
        self.publisher.publish(transform)


class Lidar(Node):
    """Scans 20 times per second."""

    def __init__(self):
        super().__init__("lidar")
        self.publisher = self.create_publisher(LaserScan, "scan", 10)
        self.create_timer(0.05, self.tick)

    def tick(self):
        scan = LaserScan()
        scan.header.stamp = self.get_clock().now().to_msg()
        self.publisher.publish(scan)


class Mapper(Node):
    """Puts each scan where the robot was."""

    def __init__(self):
        super().__init__("mapper")
        self.buffer = deque(maxlen=100)
        self.mapped = 0
        self.publisher = self.create_publisher(Int32, "mapped", 10)
        self.create_subscription(TransformStamped, "tf", self.on_transform, 10)
        self.create_subscription(LaserScan, "scan", self.on_scan, 10)

    def on_transform(self, transform):
        self.buffer.append(transform)

    def lookup(self, stamp):
        """Return the pose at a time, as far as it has been heard of."""
        newest = Time.from_msg(self.buffer[-1].header.stamp) if self.buffer else Time(seconds=0)
        if not self.buffer or stamp > newest + Duration(nanoseconds=20_000_000):
            raise LookupError("lookup would require extrapolation into the future")
        return self.buffer[-1]

    def on_scan(self, scan):
        self.add(self.lookup(Time.from_msg(scan.header.stamp)), scan)

    def add(self, transform, scan):
        self.mapped += 1
        self.publisher.publish(Int32(data=self.mapped))


class PatientMapper(Mapper):
    """Keeps a scan until its pose is there."""

    def __init__(self):
        self.waiting = deque(maxlen=10)
        super().__init__()

    def on_scan(self, scan):
        self.waiting.append(scan)
        self.drain()

    def on_transform(self, transform):
        super().on_transform(transform)
        self.drain()

    def drain(self):
        while self.waiting:
            try:
                transform = self.lookup(Time.from_msg(self.waiting[0].header.stamp))
            except LookupError:
                return
            self.add(transform, self.waiting.popleft())
