"""A plot of series in braille dots: eight to a cell, so that curves are curves in a terminal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rsltrace_viewer.model.plots.series import Series

_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], dtype=np.uint16)
"""The bit of each dot, by row and column within a cell."""


@dataclass(frozen=True, slots=True)
class Plot:
    """Cells of a plot: ``rows`` of text, ``owner`` 0 (nothing), 1 (a), 2 (b) or 3 (both) per cell.

    ``low`` … ``high`` are the values at the bottom and top, ``start`` … ``end`` the times.
    """

    rows: tuple[str, ...]
    owner: tuple[tuple[int, ...], ...]
    low: float
    high: float
    start: float
    end: float


def plot(series: list[Series], width: int, height: int, cursor_s: float | None = None) -> Plot:
    """Draw one or two series into ``width`` x ``height`` cells; ``cursor_s`` is a vertical line.

    Consecutive points are joined. The second series is drawn with gaps, so that the two can be
    told apart without colour. Values that are not finite are left out.
    """
    width, height = max(width, 1), max(height, 1)
    low, high, start, end = _bounds(series)
    dots = np.zeros((2, height * 4, width * 2), dtype=np.bool_)
    for which, one in enumerate(series[:2]):
        finite = np.isfinite(one.values) & np.isfinite(one.times)
        times, values = one.times[finite], one.values[finite]
        if not len(times):
            continue
        x = (times - start) / (end - start) * (width * 2 - 1)
        y = (high - values) / (high - low) * (height * 4 - 1)
        _draw(dots[which], x, y)
        if which == 1:
            dots[1, :, 1::4] = False
            dots[1, :, 2::4] = False
    cells = np.zeros((2, height, width), dtype=np.uint16)
    for row in range(4):
        for column in range(2):
            cells |= np.where(dots[:, row::4, column::2], _DOTS[row, column], 0).astype(np.uint16)
    owner = (cells[0] > 0) * 1 + (cells[1] > 0) * 2
    merged = cells[0] | cells[1]
    text = [[chr(0x2800 + code) if code else " " for code in line] for line in merged.tolist()]
    if cursor_s is not None and start <= cursor_s <= end:
        column = int((cursor_s - start) / (end - start) * (width - 1))
        for line in text:
            if line[column] == " ":
                line[column] = "│"
    rows = tuple("".join(line) for line in text)
    return Plot(rows, tuple(tuple(line) for line in owner.tolist()), low, high, start, end)


def _bounds(series: list[Series]) -> tuple[float, float, float, float]:
    values = np.concatenate([s.values[np.isfinite(s.values)] for s in series] or [np.zeros(0)])
    times = np.concatenate([s.times for s in series] or [np.zeros(0)])
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    start, end = (float(times.min()), float(times.max())) if len(times) else (0.0, 1.0)
    if high == low:
        # A constant runs through the middle.
        margin = abs(high) * 0.1 or 1.0
        low, high = low - margin, high + margin
    if end == start:
        end = start + 1.0
    return low, high, start, end


def _draw(
    dots: npt.NDArray[np.bool_], x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
) -> None:
    """Set the dots of the line through the points."""
    dots[np.rint(y).astype(np.intp), np.rint(x).astype(np.intp)] = True
    for x0, y0, x1, y1 in zip(x[:-1], y[:-1], x[1:], y[1:], strict=True):
        steps = int(max(abs(x1 - x0), abs(y1 - y0)))
        if steps > 1:
            along = np.linspace(0.0, 1.0, steps + 1)
            columns = np.rint(x0 + (x1 - x0) * along).astype(np.intp)
            dots[np.rint(y0 + (y1 - y0) * along).astype(np.intp), columns] = True
