"""Paths: a smooth loop through waypoints, its parts, and how to steer along one. No ROS in here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

Point = tuple[float, float]


def distance(a: Point, b: Point) -> float:
    """Return the distance between two points, in metres."""
    return math.hypot(b[0] - a[0], b[1] - a[1])


def smooth_loop(waypoints: Sequence[Point], spacing: float) -> list[Point]:
    """Return a closed Catmull-Rom curve through ``waypoints`` as points ``spacing`` metres apart.

    The last point is about one spacing before the first, which is not repeated.

    :raises ValueError: fewer than three waypoints, two equal ones in a row, or no spacing.
    """
    count = len(waypoints)
    if count < 3:
        raise ValueError(f"a loop needs at least three waypoints, there are {count}")
    if not spacing > 0:
        raise ValueError(f"the spacing must be above 0, is {spacing}")
    dense: list[Point] = []
    for i in range(count):
        before, start, end, after = (waypoints[(i + k) % count] for k in (-1, 0, 1, 2))
        if start == end:
            raise ValueError(f"waypoint {i} and the next one are both at {start}")
        steps = max(8, math.ceil(distance(start, end) / spacing) * 4)
        dense += [_catmull_rom(before, start, end, after, k / steps) for k in range(steps)]
    return _resample([*dense, dense[0]], spacing)[:-1]


def _catmull_rom(p0: Point, p1: Point, p2: Point, p3: Point, t: float) -> Point:
    def along(a: float, b: float, c: float, d: float) -> float:
        slope = c - a
        bend = 2 * a - 5 * b + 4 * c - d
        twist = 3 * (b - c) + d - a
        return b + 0.5 * t * (slope + t * (bend + t * twist))

    return along(p0[0], p1[0], p2[0], p3[0]), along(p0[1], p1[1], p2[1], p3[1])


def _resample(points: Sequence[Point], spacing: float) -> list[Point]:
    length = 0.0
    for a, b in pairwise(points):  # from Python 3.12 on, sum() rounds in another way
        length += distance(a, b)
    # Stretched a little, so that a whole number of spacings fits.
    step = length / max(1, round(length / spacing))
    result = [points[0]]
    to_go = step
    for a, b in pairwise(points):
        gap = distance(a, b)
        done = 0.0
        while gap - done >= to_go - 1e-9:
            done += to_go
            result.append((a[0] + (b[0] - a[0]) * done / gap, a[1] + (b[1] - a[1]) * done / gap))
            to_go = step
        to_go -= gap - done
    return result


def nearest(points: Sequence[Point], position: Point) -> int:
    """Return the index of the point nearest to ``position``, the first of equally near ones."""
    return min(range(len(points)), key=lambda i: distance(points[i], position))


def section(loop: Sequence[Point], start: Point, goal: Point) -> list[Point]:
    """Return the part of ``loop``, in its direction, from near ``start`` to near ``goal``.

    A goal where the start is means once around.
    """
    first, last = nearest(loop, start), nearest(loop, goal)
    if last <= first:
        last += len(loop)
    return [loop[i % len(loop)] for i in range(first, last + 1)]


@dataclass(frozen=True, slots=True)
class Limits:
    """What the robot may do: speed [m/s], sideways acceleration [m/s²], yaw rate [rad/s]."""

    speed: float
    sideways: float
    yaw_rate: float


class PurePursuit:
    """Steers towards a point of the path some way ahead."""

    def __init__(self, path: Sequence[Point], lookahead: float, limits: Limits) -> None:
        """``lookahead`` in metres. :raises ValueError: an empty path."""
        if not path:
            raise ValueError("there is no path to follow")
        self._path = path
        self._lookahead = lookahead
        self._limits = limits
        self._passed = 0

    @property
    def finished(self) -> bool:
        """Whether the last point of the path was reached."""
        return self._passed >= len(self._path) - 1

    def command(self, x: float, y: float, yaw: float) -> tuple[float, float]:
        """Return (speed [m/s], yaw rate [rad/s]) for a robot at this pose."""
        path, here = self._path, (x, y)
        # Only forwards, and not far: on a loop the end of the path lies where its start is.
        window = path[self._passed : self._passed + 20]
        self._passed += nearest(window, here)
        target = path[-1]
        for point in path[self._passed :]:
            if distance(point, here) >= self._lookahead:
                target = point
                break
        dx, dy = target[0] - x, target[1] - y
        reach = max(math.hypot(dx, dy), 0.1)
        sideways = -math.sin(yaw) * dx + math.cos(yaw) * dy
        curvature = 2 * sideways / (reach * reach)
        limits = self._limits
        speed = limits.speed
        if curvature:
            speed = min(speed, math.sqrt(limits.sideways / abs(curvature)))
        yaw_rate = max(-limits.yaw_rate, min(limits.yaw_rate, speed * curvature))
        return speed, yaw_rate
