"""The middleware with rclpy nodes as its participants: the same fixture as for their door."""

from tests.doors.conftest import simulate

__all__ = ["simulate"]
