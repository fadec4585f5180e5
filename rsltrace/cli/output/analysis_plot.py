"""The picture of ``rsltrace analyze``: for each chain its bound, what was seen, its deadline."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from textwrap import fill

from rsltrace.errors import OutputError, SetupError
from rsltrace.timing.analysis import Analysis

_SUFFIXES = (".png", ".svg", ".pdf")
_NS_PER_MS = 1e6


def check_plot(path: Path) -> None:
    """Raise what would be wrong with drawing to ``path``.

    :raises SetupError: matplotlib is not installed.
    :raises OutputError: nothing can be drawn to such a file.
    """
    if find_spec("matplotlib") is None:
        raise SetupError("--plot needs matplotlib: pip install matplotlib")
    if path.suffix not in _SUFFIXES:
        raise OutputError(f"{path}: give a name that ends in {', '.join(_SUFFIXES)}")
    if not path.absolute().parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}")


def draw(found: Analysis, path: Path) -> None:
    """Draw the chains of an analysis, the first at the top.

    :raises OutputError: the file cannot be written.
    """
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
    try:
        figure.savefig(path, dpi=150)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}") from error
