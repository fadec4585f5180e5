"""The filter: where a planar robot is, from its wheels, its gyro and GPS. No ROS in here.

State: x, y [m], yaw [rad], forward speed v [m/s], yaw rate w [rad/s]. Every measurement is of one
state variable, so an update is a few sums over rows: no matrix is inverted and no BLAS is called.
The order of every addition is written down here, which makes results the same on any processor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

X, Y, YAW, V, W = range(5)

Matrix = NDArray[np.float64]


def wrap_angle(angle: float) -> float:
    """Return ``angle`` in radians moved into (-pi, pi]."""
    wrapped = math.remainder(angle, 2 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped


@dataclass(frozen=True, slots=True)
class Noise:
    """How much the state wanders between measurements, as standard deviations per root second."""

    position: float = 0.02
    yaw: float = 0.005
    speed: float = 0.5
    yaw_rate: float = 0.8


class Ekf:
    """An extended Kalman filter for a unicycle with constant speed and yaw rate in between.

    Times are integer nanoseconds. ``state`` has shape (5,), ``covariance`` (5, 5); both are the
    filter's own arrays, not copies.
    """

    def __init__(self, noise: Noise | None = None) -> None:
        noise = noise or Noise()
        sigmas = (noise.position, noise.position, noise.yaw, noise.speed, noise.yaw_rate)
        self._drift: Matrix = np.array([sigma * sigma for sigma in sigmas])
        self.state: Matrix = np.zeros(5)
        self.covariance: Matrix = np.diag([0.01, 0.01, 1e-4, 0.01, 0.01])
        self.stamp_ns: int | None = None

    def set_pose(self, x: float, y: float, yaw: float) -> None:
        """Start at a known pose, standing still."""
        self.state[:] = (x, y, wrap_angle(yaw), 0.0, 0.0)

    def advance(self, stamp_ns: int) -> None:
        """Predict the state at ``stamp_ns``.

        A stamp before the last one changes nothing: a measurement that comes late by a sensor's
        latency is taken as one of now.
        """
        if self.stamp_ns is None:
            self.stamp_ns = stamp_ns
            return
        elapsed_ns = stamp_ns - self.stamp_ns
        if elapsed_ns <= 0:
            return
        self.stamp_ns = stamp_ns
        self._predict(elapsed_ns * 1e-9)

    def _predict(self, dt: float) -> None:
        state, covariance = self.state, self.covariance
        yaw, v, w = float(state[YAW]), float(state[V]), float(state[W])
        middle = yaw + 0.5 * w * dt
        ahead, left = math.cos(middle) * dt, math.sin(middle) * dt
        state[X] += v * ahead
        state[Y] += v * left
        state[YAW] = wrap_angle(yaw + w * dt)

        # F P F': F is the identity but for the rows of x, y and yaw. Applied to P, then to its
        # transpose, which is a view of the same memory.
        for p in (covariance, covariance.T):
            turned = p[YAW] + 0.5 * dt * p[W]
            p[X] += ahead * p[V] - (v * left) * turned
            p[Y] += left * p[V] + (v * ahead) * turned
            p[YAW] += dt * p[W]
        covariance.flat[::6] += self._drift * dt
        # Rows first and columns second round differently; over hours the halves would drift apart.
        covariance += covariance.T.copy()
        covariance *= 0.5

    def update_yaw_rate(self, yaw_rate: float, variance: float) -> None:
        """Take in a measured yaw rate [rad/s]."""
        self._update(W, yaw_rate - float(self.state[W]), variance)

    def update_speed(self, speed: float, variance: float) -> None:
        """Take in a measured forward speed [m/s]."""
        self._update(V, speed - float(self.state[V]), variance)

    def update_position(self, x: float, y: float, variance: float, gate: float = 0.0) -> bool:
        """Take in a measured position [m], both coordinates with ``variance`` [m²].

        A position more than ``gate`` standard deviations away is refused (0: none is). Returns
        whether it was taken.
        """
        if gate > 0 and self.position_distance(x, y, variance) > gate:
            return False
        self._update(X, x - float(self.state[X]), variance)
        self._update(Y, y - float(self.state[Y]), variance)
        return True

    def position_distance(self, x: float, y: float, variance: float) -> float:
        """Return how many standard deviations (Mahalanobis) a measured position is away."""
        dx, dy = x - float(self.state[X]), y - float(self.state[Y])
        sxx = float(self.covariance[X, X]) + variance
        syy = float(self.covariance[Y, Y]) + variance
        sxy = float(self.covariance[X, Y])
        squared = (syy * dx * dx - 2 * sxy * dx * dy + sxx * dy * dy) / (sxx * syy - sxy * sxy)
        return math.sqrt(max(0.0, squared))

    def _update(self, index: int, innovation: float, variance: float) -> None:
        row = self.covariance[index].copy()
        total = float(row[index]) + variance
        state = self.state
        state += row * (innovation / total)
        state[YAW] = wrap_angle(float(state[YAW]))
        # Products of a row with itself are symmetric to the last bit, and so stays the covariance.
        self.covariance -= row[:, None] * row / total

    def move_frame(self, turn: float, x: float, y: float, yaw_variance: float) -> None:
        """Express the state in another frame: turned by ``turn`` [rad], then shifted by (x, y).

        ``yaw_variance`` [rad²] is how uncertain the turn is.
        """
        cosine, sine = math.cos(turn), math.sin(turn)
        old_x, old_y = float(self.state[X]), float(self.state[Y])
        self.state[X] = x + cosine * old_x - sine * old_y
        self.state[Y] = y + sine * old_x + cosine * old_y
        self.state[YAW] = wrap_angle(float(self.state[YAW]) + turn)
        for p in (self.covariance, self.covariance.T):
            row_x = p[X].copy()
            p[X] = cosine * row_x - sine * p[Y]
            p[Y] = sine * row_x + cosine * p[Y]
        self.covariance[YAW, YAW] += yaw_variance
