"""A generated yard: a wall around it, boxes and pillars beside the way; and rays cast in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidar_demo.course import Course

Array = NDArray[np.float64]
FAR = 1e6


class Yard:
    """Boxes and pillars in a walled yard, from ``seed``; all lengths in metres."""

    def __init__(self, seed: int, course: Course, *, boxes: int = 14, pillars: int = 10) -> None:
        chance = np.random.default_rng(seed)
        way, _ = course.poses(np.linspace(0.0, 60.0, 400))
        self._walls = np.array([[-19.0, -14.0, 0.0], [19.0, 14.0, 30.0]])
        places = _beside(chance, way[:, :2], boxes + pillars)
        half = chance.uniform(0.4, 1.1, (boxes, 2))
        tops = chance.uniform(0.8, 4.0, boxes)
        low = np.column_stack([places[:boxes] - half, np.zeros(boxes)])
        self._boxes = np.stack([low, np.column_stack([places[:boxes] + half, tops])])
        self._pillars = places[boxes:]
        self._radii = chance.uniform(0.15, 0.4, pillars)

    def ranges(self, origins: Array, directions: Array) -> Array:
        """Return how far rays go, shape (n,); origins and unit directions have shape (n, 3)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / directions
            nearest = _slab(self._walls[:, None, :], origins, inverse)[1][:, 0]
            into, out = _slab(self._boxes, origins, inverse)
            hit = (into < out) & (into > 0.0)
            nearest = np.minimum(nearest, np.where(hit, into, FAR).min(axis=1))
            return np.minimum(nearest, self._to_pillars(origins, directions))

    def _to_pillars(self, origins: Array, directions: Array) -> Array:
        """Return how far it is along rays to the nearest pillar, which has no end above."""
        to = self._pillars[None, :, :] - origins[:, None, :2]
        flat = directions[:, None, :2]
        a = (flat**2).sum(axis=2)
        along = (to * flat).sum(axis=2)
        left = along**2 - a * ((to**2).sum(axis=2) - self._radii**2)
        reach = (along - np.sqrt(np.maximum(left, 0.0))) / a
        nearest: Array = np.where((left > 0.0) & (reach > 0.0), reach, FAR).min(axis=1)
        return nearest


def _slab(corners: Array, origins: Array, inverse: Array) -> tuple[Array, Array]:
    """Return where rays enter and leave boxes with ``corners`` (2, boxes, 3): two of (n, boxes)."""
    into, out = np.array(-FAR), np.array(FAR)
    for axis in range(3):
        scale = inverse[:, None, axis]
        low = (corners[0, :, axis] - origins[:, None, axis]) * scale
        high = (corners[1, :, axis] - origins[:, None, axis]) * scale
        into, out = np.maximum(into, np.minimum(low, high)), np.minimum(out, np.maximum(low, high))
    return into, out


def _beside(chance: np.random.Generator, way: Array, count: int) -> Array:
    """Return places in the yard, shape (count, 2), that leave the way free."""
    found: list[Array] = []
    while len(found) < count:
        place = chance.uniform((-17.5, -12.5), (17.5, 12.5))
        if np.hypot(*(way - place).T).min() > 2.4:
            found.append(place)
    return np.array(found)
