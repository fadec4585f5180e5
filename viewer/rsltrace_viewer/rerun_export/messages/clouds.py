"""Colours of point clouds: each topic's own, from dark below to bright above.

Rerun's loader gives all points of a cloud one colour, in which walls and ground are one heap.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from rsltrace_viewer.rerun_export.columns import lists
from rsltrace_viewer.rerun_export.messages.shapes import Paint

_DARKEST = 0.3
_LOW, _HIGH = 2, 98
"""In per cent: what is above or below is a stray point."""

Box = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]


def shaded(positions: pa.ListArray, paint: Paint) -> pa.ListArray:
    """Return a colour for each point of each cloud (a row of ``positions``)."""
    counts = np.asarray(positions.value_lengths().fill_null(0).to_numpy(), dtype=np.int64)
    heights = _points(positions)[:, 2]
    known = np.isfinite(heights)
    low, high = np.percentile(heights[known], (_LOW, _HIGH)) if known.any() else (0.0, 0.0)
    part = np.clip((heights - low) / max(high - low, 1e-9), 0.0, 1.0)
    bright = np.where(known, _DARKEST + (1 - _DARKEST) * part, 1.0)
    colours = np.full(len(heights), 255, dtype=np.uint32)
    for shift in (24, 16, 8):
        channel = (bright * (paint.rgba >> shift & 255)).astype(np.uint32)
        colours |= channel << np.uint32(shift)
    return lists(counts, pa.array(colours))


def extent(positions: pa.ListArray) -> Box | None:
    """Return the corners of the box that nearly all points of some clouds are in."""
    points = _points(positions)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    low, high = np.percentile(points, (_LOW, _HIGH), axis=0)
    return low, high


def _points(positions: pa.ListArray) -> npt.NDArray[np.float64]:
    """Return the points of all rows, shape (n, 3)."""
    values = positions.flatten().flatten().to_numpy(zero_copy_only=False)
    return np.asarray(values, dtype=np.float64).reshape(-1, 3)
