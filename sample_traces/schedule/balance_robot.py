"""A robot that balances: three timers are due at the same moments, and their order matters.

Which of two timers that are due at once runs first is nobody's promise: rclcpp decides by a heap,
rclpy by the order of a list. Here the controller uses whatever angle was estimated last.
"""

import math

from rclpy.node import Node
from std_msgs.msg import Float64


class Estimator(Node):
    """Estimates the tilt of the robot every 10 ms."""

    def __init__(self):
        super().__init__("estimator")
        self.tilt = self.create_publisher(Float64, "tilt", 1)
        self.create_timer(0.01, self.estimate)

    def estimate(self):
        seconds = self.get_clock().now().nanoseconds / 1e9
        self.tilt.publish(Float64(data=0.1 * math.sin(5.0 * seconds)))


class Logger(Node):
    """Reports the battery every 50 ms."""

    def __init__(self):
        super().__init__("battery")
        self.voltage = self.create_publisher(Float64, "battery", 1)
        self.level = 12.6
        self.create_timer(0.05, self.report)

    def report(self):
        self.level -= 0.0001
        self.voltage.publish(Float64(data=self.level))


class Controller(Node):
    """Sets the wheels' torque every 20 ms from the last tilt it heard of."""

    def __init__(self):
        super().__init__("controller")
        self.torque = self.create_publisher(Float64, "torque", 1)
        self.last = 0.0
        self.tilt = 0.0
        self.create_subscription(Float64, "tilt", self.on_tilt, 1)
        self.create_timer(0.02, self.control)

    def on_tilt(self, message):
        self.tilt = message.data

    def control(self):
        speed = (self.tilt - self.last) / 0.02
        self.last = self.tilt
        self.torque.publish(Float64(data=-(40.0 * self.tilt + 1.5 * speed)))
