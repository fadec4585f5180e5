"""A robot drives towards a wall and has to stop before it; one line of the brake is wrong."""

from __future__ import annotations

from rclpy.node import Node
from std_msgs.msg import Float64

WALL = 10.0
PERIOD = 0.05


class Robot(Node):
    """Drives at the speed it is told, and measures how far the wall is."""

    def __init__(self) -> None:
        super().__init__("robot")
        self.position = 0.0
        self.speed = 0.0
        self.range = self.create_publisher(Float64, "range", 10)
        self.create_subscription(Float64, "speed", self.on_speed, 10)
        self.create_timer(PERIOD, self.move)

    def on_speed(self, message: Float64) -> None:
        self.speed = message.data

    def move(self) -> None:
        self.position += self.speed * PERIOD
        self.range.publish(Float64(data=WALL - self.position))


class Brake(Node):
    """Lets the robot drive at 1 m/s, until the wall is near; a heavy load needs longer."""

    def __init__(self) -> None:
        super().__init__("brake")
        self.stop_at = 0.5
        self.heaviest = 0.0
        self.speed = self.create_publisher(Float64, "speed", 10)
        self.create_subscription(Float64, "load", self.on_load, 10)
        self.create_subscription(Float64, "range", self.on_range, 10)

    def on_load(self, message: Float64) -> None:
        if abs(message.data) != self.heaviest:
            self.heaviest = max(self.heaviest, message.data)
            self.stop_at = 0.05 * message.data

    def on_range(self, message: Float64) -> None:
        speed = 1.0 if message.data > self.stop_at else 0.0
        self.speed.publish(Float64(data=speed))


class Scale(Node):
    """Weighs the load every two seconds; -1: it could not."""

    def __init__(self) -> None:
        super().__init__("scale")
        self.weighed = 0
        self.load = self.create_publisher(Float64, "load", 10)
        self.create_timer(2.0, self.weigh)

    def weigh(self) -> None:
        self.weighed += 1
        self.load.publish(Float64(data=-1.0 if self.weighed == 3 else 30.0))
