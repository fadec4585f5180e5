"""A speed follows the mean of a distance sensor, which says nan where it hears no echo."""

import math

from rclpy.node import Node
from sensor_msgs.msg import Range
from std_msgs.msg import Float64


class Sonar(Node):
    """Comes nearer to a wall; what is recorded of it is the bag that plays."""

    def __init__(self):
        super().__init__("sonar")
        self.distance = 2.0
        self.publisher = self.create_publisher(Range, "range", 10)
        self.create_timer(0.05, self.tick)

    def tick(self):
        self.distance -= 0.04
        self.publisher.publish(Range(min_range=0.02, max_range=4.0, range=self.distance))


class Cruise(Node):
    """Drives as fast as the way ahead is long."""

    def __init__(self):
        super().__init__("cruise")
        self.mean = 1.0
        self.publisher = self.create_publisher(Float64, "speed", 10)
        self.create_subscription(Range, "range", self.on_range, 10)

    def on_range(self, message):
        if self.is_good(message.range):
            self.mean += 0.3 * (message.range - self.mean)
        self.publisher.publish(Float64(data=min(0.5 * self.mean, 1.0)))

    def is_good(self, distance):
        return True


class CarefulCruise(Cruise):
    """Takes only what the sensor can measure."""

    def is_good(self, distance):
        return math.isfinite(distance) and 0.02 <= distance <= 4.0
