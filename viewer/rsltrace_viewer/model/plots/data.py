"""What a screen of plots needs of what it plots: runs, or recordings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from rsltrace_viewer.model.plots.series import Series, Source


class PlotData(Protocol):
    """One or two things to plot. What decodes messages raises RsltraceError."""

    def title(self) -> str:
        """Return the names of what is plotted."""
        ...

    def topics(self) -> list[str]:
        """Return the topics with messages."""
        ...

    def others(self) -> list[Source]:
        """Return what else can be plotted: rates, latencies."""
        ...

    def fields(self, topic: str) -> list[Source]:
        """Return the numeric fields of a topic."""
        ...

    def first(self) -> tuple[str, str]:
        """Return topic and field to begin with; either may be empty."""
        ...

    def cursor_s(self) -> float | None:
        """Return the time of what is selected."""
        ...

    def series(self, source: Source) -> Iterator[list[Series]]:
        """Yield the series of each run as they become known, the last time whole."""
        ...


def difference(series: list[Series]) -> Series | None:
    """Return a - b at the times of a, as far as b goes; None if there are no two."""
    if len(series) < 2 or not len(series[0].times) or not len(series[1].times):
        return None
    a, b = series
    inside = (a.times >= b.times[0]) & (a.times <= b.times[-1])
    times = a.times[inside]
    if not len(times):
        return None
    values = a.values[inside] - np.interp(times, b.times, b.values)
    finite = np.abs(values[np.isfinite(values)])
    most = float(finite.max()) if len(finite) else 0.0
    return Series(times, values, f"|a − b| ≤ {most:.4g}")
