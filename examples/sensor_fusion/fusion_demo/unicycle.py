"""The robot whose sensors are simulated: a unicycle with sluggish motors. No ROS in here."""

from __future__ import annotations

import math


class Unicycle:
    """Ground truth. Position [m], yaw [rad], forward speed [m/s], yaw rate [rad/s].

    Speeds approach their set points exponentially with ``lag`` seconds. ``acceleration`` [m/s²] is
    that of the last step, along the robot.
    """

    def __init__(self, x: float, y: float, yaw: float, *, lag: float = 0.25) -> None:
        self.x, self.y, self.yaw = x, y, yaw
        self.speed = self.yaw_rate = self.acceleration = 0.0
        self._lag = lag

    def step(self, dt: float, speed: float, yaw_rate: float) -> None:
        """Move on by ``dt`` seconds towards the set points ``speed`` and ``yaw_rate``."""
        if dt <= 0:
            return
        share = 1.0 - math.exp(-dt / self._lag)
        before = self.speed
        self.speed += share * (speed - self.speed)
        self.yaw_rate += share * (yaw_rate - self.yaw_rate)
        self.acceleration = (self.speed - before) / dt
        middle = self.yaw + 0.5 * self.yaw_rate * dt
        self.x += self.speed * math.cos(middle) * dt
        self.y += self.speed * math.sin(middle) * dt
        self.yaw = math.remainder(self.yaw + self.yaw_rate * dt, 2 * math.pi)
