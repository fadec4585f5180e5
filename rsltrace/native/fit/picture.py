"""What was measured and what a simulation draws, as a picture: shares of values below a time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from rsltrace.checks.latency.instances import Durations
from rsltrace.native.fit.fitted_job import Fit
from rsltrace.native.fit.models import DurationModel
from rsltrace.trace.model.texts import printable

Numbers = npt.NDArray[np.float64]
_COLUMNS = 3
_INCHES = (4.2, 2.8)
_PANELS_MAX = 60
_POINTS_MAX = 2_000
_MS = 1e6
_WIDE = 5
"""From so many medians to the longest on, the axis is logarithmic."""


def picture_of(fit: Fit, title: str) -> Any:
    """Return a panel for each link and each callback, up to 60, those with the most values first,
    as a figure of matplotlib's."""
    from matplotlib.figure import Figure

    panels = sorted(_panels(fit), key=lambda panel: -len(panel[1]))[:_PANELS_MAX]
    panels.sort(key=lambda panel: panel[0])
    rows = -(-len(panels) // _COLUMNS) or 1
    width, height = _INCHES
    figure = Figure(figsize=(width * _COLUMNS, height * rows + 0.6), layout="constrained")
    figure.suptitle(printable(f"{os.path.basename(title)}: measured, and what a simulation draws"))
    for place, (name, durations, model) in enumerate(panels):
        axes = figure.add_subplot(rows, _COLUMNS, place + 1)
        for values, label, line in (
            (durations, f"measured ({len(durations)})", "-"),
            (model.draws(), f"{model.kind}, D {model.distance:.3f}", "--"),
        ):
            x, y = _shares(values)
            axes.plot(x, y, line, label=label, drawstyle="steps-post")
        if model.draws().min() > 0 and durations.max() > _WIDE * np.median(durations):
            axes.set_xscale("log")
        axes.set_title(_plain(name), fontsize=8)
        axes.set_xlabel("ms", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.set_ylim(0, 100)
        axes.set_ylabel("% below", fontsize=8)
        axes.legend(fontsize=7, loc="lower right")
    return figure


def _panels(fit: Fit) -> Iterator[tuple[str, Durations, DurationModel]]:
    for link, model in fit.links:
        yield f"delay  {link}", link.delays, model
    for one, model in fit.executions:
        yield f"execution  {one.node}: {one.kind} {one.entity}", one.busy, model


def _plain(name: str) -> str:
    """Return a name without what matplotlib takes for mathematics."""
    return printable(name).replace("$", r"\$")


def _shares(values: Durations) -> tuple[Numbers, Numbers]:
    """Return times in ms, and the percentage of values that do not exceed each."""
    places = np.unique(np.linspace(0, len(values) - 1, min(len(values), _POINTS_MAX)).astype(int))
    return np.sort(values)[places] / _MS, (places + 1) * 100 / len(values)
