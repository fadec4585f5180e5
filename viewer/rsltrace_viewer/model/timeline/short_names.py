"""Names that are too long for their place, cut so that they can still be told from each other.

Names on a robot share much: a namespace at the beginning, a kind of sensor at the end. Cut at the
end they may all look the same, so the cut is made where it leaves a name that no other one has.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable

from rich.cells import set_cell_size

from rsltrace_viewer.model.cells import cells, fit

_Cut = Callable[[str, int], str]


class ShortNames:
    """A set of names, and how each is written in so many cells."""

    def __init__(self, names: Iterable[str]) -> None:
        self._names = sorted(set(names))
        self._by_width: dict[int, dict[str, str]] = {}

    def fit(self, name: str, width: int) -> str:
        """Return ``name`` in exactly ``width`` cells. One that is not in the set is cut as text."""
        if width <= 0 or cells(name) <= width:
            return fit(name, width)
        known = self._by_width.get(width)
        if known is None:
            known = self._by_width[width] = self._cut(width)
        return known.get(name) or fit(name, width)

    def _cut(self, width: int) -> dict[str, str]:
        """Return the cut form of all names that are longer than ``width``."""
        chosen: dict[str, str] = {}
        for cut in (fit, _in_the_middle, _at_the_start):
            forms = {name: cut(name, width) for name in self._names}
            count = Counter(forms.values())
            for name, form in forms.items():
                if cells(name) > width and name not in chosen and count[form] == 1:
                    chosen[name] = form
        return chosen


def _in_the_middle(name: str, width: int) -> str:
    if cells(name) <= width:
        return fit(name, width)
    tail = _tail(name, width // 2)
    return set_cell_size(name, width - 1 - cells(tail)) + "…" + tail


def _at_the_start(name: str, width: int) -> str:
    if cells(name) <= width:
        return fit(name, width)
    tail = _tail(name, width - 1)
    return "…" + tail + " " * (width - 1 - cells(tail))


def _tail(name: str, width: int) -> str:
    """Return the longest end of ``name`` that takes at most ``width`` cells."""
    start = max(len(name) - width, 0)
    while cells(name[start:]) > width:
        start += 1
    return name[start:]
