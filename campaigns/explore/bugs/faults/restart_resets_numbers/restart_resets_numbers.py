"""A sensor counts its messages; after a restart all of its numbers are old ones."""

from rclpy.node import Node
from std_msgs.msg import Int32


class Sensor(Node):
    """Publishes numbered measurements."""

    def __init__(self):
        super().__init__("sensor")
        self.number = 0
        self.publisher = self.create_publisher(Int32, "measured", 10)
        self.create_timer(0.05, self.tick)

    def tick(self):
        self.number += 1
        self.publisher.publish(Int32(data=self.number))


class Filter(Node):
    """Lets each number through once."""

    def __init__(self):
        super().__init__("filter")
        self.last = 0
        self.publisher = self.create_publisher(Int32, "accepted", 10)
        self.create_subscription(Int32, "measured", self.on_measured, 10)

    def on_measured(self, message):
        if message.data > self.last:
            self.last = message.data
            self.publisher.publish(message)


class RestartableFilter(Filter):
    """Knows that who begins at 1 has started again."""

    def on_measured(self, message):
        if message.data == 1:
            self.last = 0
        super().on_measured(message)
