"""The way that the robot drives: known at every time, so that odometry can be judged by it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HEIGHT = 1.0
"""Of the LiDAR above the ground, in metres."""


class Course:
    """Laps of an ellipse, begun at rest; half-axes ``a`` and ``b`` in metres, ``speed`` in rad/s of
    the ellipse's parameter, which is reached after ``begin`` seconds."""

    def __init__(self, a: float = 11.0, b: float = 7.0, speed: float = 0.25, begin: float = 1.0):
        self._a, self._b, self._speed, self._begin = a, b, speed, begin

    def angle(self, t: Array) -> Array:
        """Return the ellipse's parameter at times ``t`` in seconds, shape (n,)."""
        early = np.minimum(t, self._begin)
        return self._speed * (early**2 / (2 * self._begin) + np.maximum(t - self._begin, 0.0))

    def poses(self, t: Array) -> tuple[Array, Array]:
        """Return positions in metres, shape (n, 3), and yaws in radians, shape (n,)."""
        angle = self.angle(np.asarray(t, dtype=np.float64))
        x, y = self._a * np.cos(angle), self._b * np.sin(angle)
        yaw = np.arctan2(self._b * np.cos(angle), -self._a * np.sin(angle))
        return np.stack([x, y, np.full_like(x, HEIGHT)], axis=1), yaw
