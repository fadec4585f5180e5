"""The middleware with rclpy nodes as its participants: the same fixture as for their door."""

from tests.adapters.conftest import simulate

__all__ = ["simulate"]
