"""The way something took, as one line through the whole run.

A line that is there from the start shows in one look where a robot went and, of two runs, where
they diverge. It is thinned out as it grows, so it costs the same for an hour as for a minute.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_POINTS_MAX = 4096


class Track:
    """Collects positions, at most some thousands of them, evenly over what was added."""

    def __init__(self) -> None:
        self._kept: list[npt.NDArray[np.float64]] = []
        self._count = 0
        self._stride = 1
        self._next = 0
        self._added = 0

    def add(self, positions: npt.NDArray[np.float64]) -> None:
        """Add positions, shape (n, k)."""
        kept = positions[self._next - self._added :: self._stride]
        self._added += len(positions)
        self._next += len(kept) * self._stride
        kept = kept[np.isfinite(kept).all(axis=1)]
        if len(kept):
            self._kept.append(kept)
            self._count += len(kept)
        while self._count > _POINTS_MAX:
            thinned = np.concatenate(self._kept)[::2]
            self._kept, self._count = [thinned], len(thinned)
            self._stride *= 2
            self._next += (-self._next) % self._stride

    @property
    def points(self) -> npt.NDArray[np.float64]:
        """What is kept, shape (n, k); empty with fewer than two points."""
        if self._count < 2:
            return np.zeros((0, 3), dtype=np.float64)
        return np.concatenate(self._kept)
