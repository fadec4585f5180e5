"""A camera, a detector, a tracker and a controller: each computes for a while, and tells the next.

How long depends on the number of the image: mostly the same, now and then three times as long.
"""

import ctypes
import hashlib
import random
from typing import Any

from rclpy.node import Node
from std_msgs.msg import UInt64

PIECE = bytes(1 << 20)
"""Hashing this once is one unit of work, of about half a millisecond to two. It is done without
Python's interpreter lock, so that nodes in one process do not wait for each other."""

ACCELERATOR = ctypes.CDLL(None)
"""Stands for the library of a GPU or the like: a call of it comes back when the work is done. It
does not ask Python for the time, so in a simulation it takes none."""


def work(units: int) -> None:
    """Compute for some units."""
    for _ in range(units):
        hashlib.sha256(PIECE)


class Camera(Node):
    """Sends numbers on /image, 20 a second."""

    def __init__(self) -> None:
        super().__init__("camera")
        self.number = 0
        self.images = self.create_publisher(UInt64, "/image", 10)
        self.create_timer(0.05, self.on_timer)

    def on_timer(self) -> None:
        work(2)
        self.images.publish(UInt64(data=self.number))
        self.number += 1


class Stage(Node):
    """Computes for each message on ``hears``, then sends its number on ``says``."""

    def __init__(self, name: str, hears: str, says: str, units: int, spread: int) -> None:
        super().__init__(name)
        self.accelerated = self.declare_parameter("accelerated", False).value
        self.units, self.spread = units, spread
        self.answers = self.create_publisher(UInt64, says, 10)
        self.create_subscription(UInt64, hears, self.on_message, 10)

    def on_message(self, message: Any) -> None:
        chance = random.Random(f"{self.get_name()} {message.data}")
        units = self.units + chance.randrange(self.spread + 1)
        units *= 3 if chance.random() < 0.05 else 1
        if self.accelerated:
            ACCELERATOR.usleep(2000 * units)
        else:
            work(units)
        self.answers.publish(UInt64(data=message.data))


class Sink(Node):
    """Receives what comes out at the end."""

    def __init__(self) -> None:
        super().__init__("actuator")
        self.create_subscription(UInt64, "/command", lambda message: None, 10)
