"""Three samplers report at once to a collector whose subscription holds one message."""

from rclpy.node import Node
from std_msgs.msg import Int32, String


class Sampler(Node):
    """Reports once."""

    def __init__(self):
        super().__init__("sampler")
        self.publisher = self.create_publisher(String, "samples", 10)
        self.timer = self.create_timer(0.5, self.report)

    def report(self):
        self.timer.cancel()
        self.publisher.publish(String(data=self.get_name()))


class Collector(Node):
    """Counts who has reported."""

    DEPTH = 1

    def __init__(self):
        super().__init__("collector")
        self.names = set()
        self.publisher = self.create_publisher(Int32, "collected", 10)
        self.create_subscription(String, "samples", self.on_sample, self.DEPTH)

    def on_sample(self, sample):
        self.names.add(sample.data)
        self.publisher.publish(Int32(data=len(self.names)))


class DeepCollector(Collector):
    """Has room for what comes at once."""

    DEPTH = 10
