"""The picture of ``rsltrace analyze``: for each chain its bound, what was seen, its deadline."""

from __future__ import annotations

from textwrap import fill
from typing import Any

from rsltrace.native.timing.analysis import Analysis

_NS_PER_MS = 1e6


def picture_of(found: Analysis) -> Any:
    """Return the chains of an analysis, the first at the top, as a figure of matplotlib's."""
    from matplotlib.figure import Figure

    chains = list(reversed(found.chains))
    figure = Figure(figsize=(9, 1.2 + 0.5 * len(chains)), layout="constrained")
    axes = figure.add_subplot()
    rows = range(len(chains))
    bounds = [(one.bound_ns or 0) / _NS_PER_MS for one in chains]
    axes.barh(rows, bounds, height=0.6, color="#c6d4e1", label="bound")
    for row, one in zip(rows, chains, strict=True):
        marks = [(one.simulated, "o", "#1b6ca8", "simulated, worst")]
        marks += [(seen, "x", "#b5482a", "native, worst") for seen in one.native]
        for seen, mark, color, label in marks:
            if seen is not None:
                axes.plot(seen.worst_ns / _NS_PER_MS, row, mark, color=color, label=label)
        if one.deadline_ns is not None:
            at = one.deadline_ns / _NS_PER_MS
            axes.plot([at, at], [row - 0.4, row + 0.4], color="black", label="deadline")
        if one.bound_ns is None:
            axes.text(0, row, " no bound", va="center", color="#b5482a")
    axes.set_yticks(list(rows), [fill(one.name, 45) for one in chains])
    axes.set_xlabel("response time in ms")
    handles, labels = axes.get_legend_handles_labels()
    shown = dict(zip(labels, handles, strict=True))
    figure.legend(shown.values(), shown.keys(), loc="outside upper center", ncols=len(shown))
    return figure
