"""Two nodes that send a number back and forth: the least a graph can do, for measuring.

By default a timer paces the game: one ping per tick, one pong as its answer. With the parameter
``burst`` each pong is answered at once, so the game runs as fast as the executor does, and under
simulated time it takes no time at all.
"""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import UInt8, UInt64

QOS = QoSProfile(depth=10)


class Ping(Node):
    """Serves numbers 1, 2, 3, ... and counts the answers.

    Parameters: ``messages``, how many answers end the game (0: it never ends); ``burst``, answer
    at once instead of with the next tick; ``period``, seconds between ticks of the timer.
    At the end 0 is published on /ping_pong/done.
    """

    def __init__(self) -> None:
        super().__init__("ping")
        self._messages = self.declare_parameter("messages", 10_000).value
        self._burst = self.declare_parameter("burst", False).value
        period = self.declare_parameter("period", 0.001).value
        self._served = 0
        self.answers = 0
        self.callbacks = 0
        self._ping = self.create_publisher(UInt64, "ping", QOS)
        self._done = self.create_publisher(UInt8, "/ping_pong/done", QOS)
        self.create_subscription(UInt64, "pong", self._on_pong, QOS)
        self._timer = self.create_timer(period, self._on_timer)

    def _on_timer(self) -> None:
        self.callbacks += 1
        # Over a network the first numbers may be lost while the nodes still discover each other:
        # an unanswered number is served again instead of the next one.
        if self._served == self.answers:
            self._served += 1
        self._ping.publish(UInt64(data=self._served))

    def _on_pong(self, message: UInt64) -> None:
        self.callbacks += 1
        if message.data != self.answers + 1:
            return  # the answer to a number that was served twice
        self.answers += 1
        if self.answers == self._messages:
            self._timer.cancel()
            self._done.publish(UInt8(data=0))
        elif self._burst:
            if self.answers == 1:
                self._timer.cancel()
            self._served += 1
            self._ping.publish(UInt64(data=self._served))


class Pong(Node):
    """Sends each number back."""

    def __init__(self) -> None:
        super().__init__("pong")
        self.callbacks = 0
        self._pong = self.create_publisher(UInt64, "pong", QOS)
        self.create_subscription(UInt64, "ping", self._on_ping, QOS)

    def _on_ping(self, message: UInt64) -> None:
        self.callbacks += 1
        self._pong.publish(UInt64(data=message.data))
