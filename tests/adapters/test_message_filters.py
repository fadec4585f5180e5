"""ROS's ``message_filters`` package, where it is installed (there are no wheels of it)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped, TwistStamped
from rclpy.node import Node

pytestmark = pytest.mark.ros
message_filters = pytest.importorskip("message_filters", reason="message_filters is not installed")


def stamp(node: Node) -> Time:
    return node.get_clock().now().to_msg()


class Sensors(Node):
    """Points every 100 ms, twists every 150 ms, stamped when they are made."""

    def __init__(self) -> None:
        super().__init__("sensors")
        self.points = self.create_publisher(PointStamped, "point", 10)
        self.twists = self.create_publisher(TwistStamped, "twist", 10)
        self.create_timer(0.1, lambda: self.send(self.points, PointStamped()))
        self.create_timer(0.15, lambda: self.send(self.twists, TwistStamped()))

    def send(self, publisher: Any, message: Any) -> None:
        message.header.stamp = stamp(self)
        publisher.publish(message)


def milliseconds(message: Any) -> int:
    return int(message.header.stamp.sec * 1000 + message.header.stamp.nanosec // 1_000_000)


@pytest.mark.parametrize("slop_s", [0.0, 0.06])
def test_synchronizers_and_caches(simulate: Callable[..., Any], slop_s: float) -> None:
    pairs: list[tuple[int, int]] = []
    cached: list[list[int]] = []

    class Fusion(Node):
        def __init__(self) -> None:
            super().__init__("fusion")
            self.inputs = [
                message_filters.Subscriber(self, PointStamped, "point"),
                message_filters.Subscriber(self, TwistStamped, "twist"),
            ]
            if slop_s:
                self.both = message_filters.ApproximateTimeSynchronizer(self.inputs, 10, slop_s)
            else:
                self.both = message_filters.TimeSynchronizer(self.inputs, 10)
            self.both.registerCallback(self.fuse)
            self.cache = message_filters.Cache(self.inputs[0], 5)
            self.create_timer(0.95, self.look)

        def fuse(self, point: PointStamped, twist: TwistStamped) -> None:
            pairs.append((milliseconds(point), milliseconds(twist)))

        def look(self) -> None:
            cached.append([milliseconds(message) for message in self.cache.cache_msgs])

    first = simulate(Fusion, Sensors, duration=1.0).result.digest
    exact = [(300, 300), (600, 600), (900, 900)]
    if slop_s:
        assert set(exact) <= set(pairs)
        assert len(pairs) > len(exact)
        assert all(abs(point - twist) <= 60 for point, twist in pairs)
    else:
        assert pairs == exact
    assert cached == [[500, 600, 700, 800, 900]]
    assert simulate(Fusion, Sensors, duration=1.0).result.digest == first
