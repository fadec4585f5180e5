"""The monitor: how far the filter, GPS and (where there is one) the truth are apart."""

from __future__ import annotations

import math
from dataclasses import dataclass

from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import NavSatFix, NavSatStatus

from fusion_demo.geodesy import LocalFrame


@dataclass
class Spread:
    """Distances, summed up as they come. ``text`` gives root mean square and largest."""

    count: int = 0
    squares: float = 0.0
    largest: float = 0.0

    def add(self, gap: float) -> None:
        """Take in one distance in metres."""
        self.count += 1
        self.squares += gap * gap
        self.largest = max(self.largest, gap)

    @property
    def text(self) -> str:
        """For a log: ``0.31 m rms, 0.92 m at most``."""
        if not self.count:
            return "nothing yet"
        return f"{math.sqrt(self.squares / self.count):.2f} m rms, {self.largest:.2f} m at most"


class TrackMonitor(Node):
    """Compares /odometry/filtered with /fix and with /ground_truth; logs every ten seconds and
    at the end.

    Parameters ``datum_latitude``, ``datum_longitude`` as the filter has them.
    """

    def __init__(self) -> None:
        super().__init__("track_monitor")
        latitude = float(self.declare_parameter("datum_latitude", math.nan).value)
        longitude = float(self.declare_parameter("datum_longitude", math.nan).value)
        self._frame: LocalFrame | None = None
        if not math.isnan(latitude) and not math.isnan(longitude):
            self._frame = LocalFrame(latitude, longitude)
        self._here: tuple[float, float] | None = None
        self._length_m = 0.0
        self._to_fix, self._to_truth = Spread(), Spread()
        self._destroyed = False
        reliable = QoSProfile(depth=10)
        self.create_subscription(Odometry, "odometry/filtered", self._on_filtered, reliable)
        self.create_subscription(Odometry, "ground_truth", self._on_truth, reliable)
        self.create_subscription(NavSatFix, "fix", self._on_fix, qos_profile_sensor_data)
        self.create_timer(10.0, self._report)

    def _on_filtered(self, odometry: Odometry) -> None:
        position = odometry.pose.pose.position
        here = position.x, position.y
        if self._here is not None:
            self._length_m += math.dist(self._here, here)
        self._here = here

    def _on_truth(self, odometry: Odometry) -> None:
        if self._here is not None:
            position = odometry.pose.pose.position
            self._to_truth.add(math.dist(self._here, (position.x, position.y)))

    def _on_fix(self, fix: NavSatFix) -> None:
        if fix.status.status == NavSatStatus.STATUS_NO_FIX:
            return
        if self._frame is None:
            self._frame = LocalFrame(fix.latitude, fix.longitude)
        if self._here is not None:
            self._to_fix.add(
                math.dist(self._here, self._frame.to_metres(fix.latitude, fix.longitude))
            )

    def _report(self) -> None:
        if self._here is None:
            self.get_logger().info("no filtered pose yet")
            return
        truth = f"; to the truth {self._to_truth.text}" if self._to_truth.count else ""
        self.get_logger().info(
            f"driven {self._length_m:.1f} m, at ({self._here[0]:.2f}, {self._here[1]:.2f}); "
            f"filter to GPS {self._to_fix.text}{truth}"
        )

    def destroy_node(self) -> None:
        """Log the last report, once, while the node can still log."""
        if not self._destroyed:
            self._destroyed = True
            self._report()
        super().destroy_node()
