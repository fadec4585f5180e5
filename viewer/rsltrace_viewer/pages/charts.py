"""Charts as SVG: curves of fields, a histogram, points over a setting, progress over the runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import accumulate
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from rsltrace.trace.model.texts import printable, shortened
from rsltrace_viewer.model.plots.series import Series

WIDTH, HEIGHT = 420, 180
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 10, 10, 34
_BINS = 24
_POINTS_MAX = 1500
_TEXT_MAX = 80
_STEPS = 200
"""Of a curve with more points, the least and the greatest in each of so many steps are drawn."""
_ASIDE = 17
"""Columns in which points over a text are spread."""

Points = Sequence[tuple[float, float, bool]]
"""x, y, and whether the run failed."""


class _Chart:
    def __init__(self, x: tuple[float, float], y: tuple[float, float], says: str) -> None:
        self._x, self._y = _wide(x), _wide(y)
        box = f"0 0 {WIDTH} {HEIGHT}"
        self.element = Element(
            "svg",
            {"viewBox": box, "class": "chart", "role": "img", "aria-label": _short(says)},
        )
        SubElement(self.element, "title").text = _short(says)

    def at(self, x: float, y: float) -> tuple[float, float]:
        left, right = self._x
        low, high = self._y
        across = _share(x, left, right) * (WIDTH - _LEFT - _RIGHT)
        up = _share(y, low, high) * (HEIGHT - _TOP - _BOTTOM)
        return round(_LEFT + across, 1), round(HEIGHT - _BOTTOM - up, 1)

    def axes(self, name: str, below: Sequence[tuple[float, str]] = ()) -> None:
        """Draw the axes; ``below`` labels places on the x axis, else its ends are labelled."""
        floor, wall = HEIGHT - _BOTTOM, _LEFT
        self._line(wall, floor, WIDTH - _RIGHT, floor)
        self._line(wall, floor, wall, _TOP)
        for value in self._y:
            self._text(wall - 5, self.at(self._x[0], value)[1] + 4, number(value), "end")
        for value, said in below:
            self._text(self.at(value, self._y[0])[0], floor + 14, said, "middle")
        if not below:
            for value, anchor in zip(self._x, ("start", "end"), strict=True):
                self._text(self.at(value, self._y[0])[0], floor + 14, number(value), anchor)
        self._text((wall + WIDTH) / 2, HEIGHT - 4, name, "middle")

    def bar(self, x: float, width: float, y: float, height: float, kind: str) -> None:
        left, top = self.at(x, y + height)
        right, floor = self.at(x + width, y)
        size = {"width": f"{max(right - left - 1, 0.5):.1f}", "height": f"{floor - top:.1f}"}
        place = {"x": f"{left:g}", "y": f"{top:g}", "class": kind, **size}
        SubElement(self.element, "rect", place)

    def point(self, x: float, y: float, kind: str) -> None:
        across, down = self.at(x, y)
        place = {"cx": f"{across:g}", "cy": f"{down:g}", "r": "2.5", "class": kind}
        SubElement(self.element, "circle", place)

    def path(self, points: Iterable[tuple[float, float]], kind: str) -> None:
        drawn = " ".join("{:g},{:g}".format(*self.at(x, y)) for x, y in points)
        SubElement(self.element, "polyline", {"points": drawn, "class": kind})

    def upright(self, x: float) -> None:
        across = self.at(x, self._y[0])[0]
        self._line(across, HEIGHT - _BOTTOM, across, _TOP)

    def _line(self, x1: float, y1: float, x2: float, y2: float) -> None:
        ends = {"x1": f"{x1:g}", "y1": f"{y1:g}", "x2": f"{x2:g}", "y2": f"{y2:g}"}
        SubElement(self.element, "line", ends)

    def _text(self, x: float, y: float, text: str, anchor: str) -> None:
        place = {"x": f"{x:g}", "y": f"{y:g}", "text-anchor": anchor}
        SubElement(self.element, "text", place).text = _short(text)


def svg_of(element: Element) -> Markup:
    """Return an element as a part of a page."""
    return Markup(tostring(element, encoding="unicode"))


def curves(series: Sequence[Series], name: str, cursor_s: float | None) -> Markup | None:
    """Draw a value over time, of one run or of two; None if there are no two points. The vertical
    line is at ``cursor_s``."""
    drawn = [
        (kind, [*zip(one.times[shown].tolist(), one.values[shown].tolist(), strict=True)])
        for kind, one in zip("ab", series, strict=False)
        if len(shown := _telling(one))
    ]
    points = [point for _, curve in drawn for point in curve]
    if len(points) < 2:
        return None
    times, values = zip(*points, strict=True)
    chart = _Chart((min(times), max(times)), (min(values), max(values)), name)
    for kind, curve in drawn:
        chart.path(curve, kind)
    if cursor_s is not None and min(times) <= cursor_s <= max(times):
        chart.upright(cursor_s)
    chart.axes("time in s")
    return svg_of(chart.element)


def _telling(one: Series) -> npt.NDArray[np.intp]:
    """Return the places of the points to draw."""
    finite = np.flatnonzero(np.isfinite(one.values) & np.isfinite(one.times))
    if len(finite) <= 2 * _STEPS:
        return finite
    steps = np.array_split(finite, _STEPS)
    ends = [step[find(one.values[step])] for step in steps for find in (np.argmin, np.argmax)]
    return np.unique(ends)


def histogram(values: Sequence[tuple[float, bool]], name: str) -> Markup:
    """Draw the distribution of a metric; failed runs are stacked on the others."""
    low, high = _wide((min(v for v, _ in values), max(v for v, _ in values)))
    counts = [[0, 0] for _ in range(_BINS)]
    for value, failed in values:
        counts[min(int(_share(value, low, high) * _BINS), _BINS - 1)][failed] += 1
    most = max(map(sum, counts))
    chart = _Chart((low, high), (0, most), f"distribution of {name}")
    width = high / _BINS - low / _BINS
    for index, (good, bad) in enumerate(counts):
        if good:
            chart.bar(low + index * width, width, 0, good, "good")
        if bad:
            chart.bar(low + index * width, width, good, bad, "bad")
    chart.axes(name)
    return svg_of(chart.element)


def scatter(points: Points, x_name: str, y_name: str, places: Sequence[str] = ()) -> Markup:
    """Draw a metric over a setting; ``places`` are the texts that x counts from 0."""
    points = [one for one in points if math.isfinite(one[0]) and math.isfinite(one[1])]
    x = (min(p[0] for p in points), max(p[0] for p in points))
    y = (min(p[1] for p in points), max(p[1] for p in points))
    if places:
        x = (-0.5, len(places) - 0.5)
    chart = _Chart(x, y, f"{y_name} over {x_name}")
    step = max(1, len(points) // _POINTS_MAX)
    for kind, failed in (("good", False), ("bad", True)):
        for index, (across, up, bad) in enumerate(points[::step]):
            aside = (index % _ASIDE / _ASIDE - 0.5) / 3 if places else 0.0
            if bad is failed:
                chart.point(across + aside, up, kind)
    chart.axes(
        f"{y_name} over {x_name}", [(float(index), said) for index, said in enumerate(places)]
    )
    return svg_of(chart.element)


def progress(new: Sequence[bool], failed: Sequence[bool]) -> Markup:
    """Draw, over the runs, how many were new and how many failed."""
    chart = _Chart((0, len(new)), (0, max(sum(new), sum(failed), 1)), "new and failed runs so far")
    for flags, kind in ((new, "good"), (failed, "bad")):
        step = max(1, len(flags) // 400)
        totals = [(0, 0), *enumerate(accumulate(map(int, flags)), 1)]
        chart.path([*totals[::step], totals[-1]], kind)
    chart.axes("runs")
    return svg_of(chart.element)


def number(value: float) -> str:
    """Return a number in few digits."""
    return f"{value:.3g}"


def _short(text: str) -> str:
    return printable(shortened(text, _TEXT_MAX))


def _wide(ends: tuple[float, float]) -> tuple[float, float]:
    """Return two numbers that differ."""
    low, high = ends
    half = 0.0 if high > low else max(0.5, abs(low) * 1e-6)
    return low - half, high + half


def _share(value: float, low: float, high: float) -> float:
    """Return how far between two numbers one is, 0 to 1; halves do not overflow."""
    if math.isfinite(high - low):
        return (value - low) / (high - low)
    return (value / 2 - low / 2) / (high / 2 - low / 2)
