"""Which way a robot looks, from the first metres it drives: odometry against GPS. No ROS in here.

Odometry has a shape but no north; GPS has north but no heading. The turn that lays the one track
on the other (least squares over pairs of points) is the heading that was missing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Alignment:
    """The turn [rad] about the origin and then the shift [m] that lay a track on another.

    ``variance`` [rad²] is how uncertain the turn is.
    """

    turn: float
    x: float
    y: float
    variance: float


class TrackAligner:
    """Collects pairs of points until ``distance`` metres were covered, then fits."""

    def __init__(self, distance: float) -> None:
        self._distance = distance
        self._pairs: list[tuple[float, float, float, float, float]] = []

    def add(
        self, local: tuple[float, float], world: tuple[float, float], variance: float
    ) -> Alignment | None:
        """Add a point in both frames; ``variance`` [m²] is that of ``world``, per coordinate.

        Returns the alignment once the track reaches far enough from where it began, else None.
        """
        self._pairs.append((*local, *world, variance))
        first_x, first_y = self._pairs[0][:2]
        if math.hypot(local[0] - first_x, local[1] - first_y) < self._distance:
            return None
        return self._fit()

    def _fit(self) -> Alignment:
        count = len(self._pairs)
        local_x = sum(pair[0] for pair in self._pairs) / count
        local_y = sum(pair[1] for pair in self._pairs) / count
        world_x = sum(pair[2] for pair in self._pairs) / count
        world_y = sum(pair[3] for pair in self._pairs) / count
        along = across = spread = variance = 0.0
        for lx, ly, wx, wy, v in self._pairs:
            lx, ly, wx, wy = lx - local_x, ly - local_y, wx - world_x, wy - world_y
            along += lx * wx + ly * wy
            across += lx * wy - ly * wx
            spread += lx * lx + ly * ly
            variance += v
        turn = math.atan2(across, along)
        cosine, sine = math.cos(turn), math.sin(turn)
        return Alignment(
            turn=turn,
            x=world_x - (cosine * local_x - sine * local_y),
            y=world_y - (sine * local_x + cosine * local_y),
            # Errors of successive fixes are alike, so more of them do not help much: the variance
            # of one fix counts, over the mean square extent of the track.
            variance=variance / spread,
        )
