"""Which part of one or two runs the lanes show: it follows the selected event, and zooms."""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace_viewer.model.lane_maker import LaneMaker
from rsltrace_viewer.model.lanes import Lanes, drawn, lettered
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.view import View, Window


class LaneWindow:
    """The lanes of ``runs`` (one or two). A selected event is (0 or 1 for its run, its index)."""

    window: Window
    whole: Window

    def __init__(self, runs: Sequence[Run]) -> None:
        self._show(runs)
        self.window = self.whole

    def _show(self, runs: Sequence[Run]) -> None:
        self._runs = runs
        self.makers = [LaneMaker(run) for run in runs]
        whole = [maker.whole for maker in self.makers]
        self.whole = Window(min(w.start for w in whole), max(w.end for w in whole))
        for maker in self.makers:
            maker.whole = self.whole
        self._made: tuple[tuple[object, ...], Lanes] | None = None

    def labels(self, view: View) -> list[str]:
        """Return the name of each lane: the nodes of a run, each twice if both runs are shown and
        have it."""
        makers = [maker for _, maker in self._shown(view)]
        names = dict.fromkeys(label for maker in makers for label in maker.labels)
        return [name for name in names for maker in makers if name in maker.labels]

    def _shown(self, view: View) -> list[tuple[str, LaneMaker]]:
        """Return the runs whose events have places, by name (empty with one trace)."""
        names = ("a", "b") if len(self.makers) > 1 else ("",)
        return [
            (name, maker)
            for name, maker in zip(names, self.makers, strict=True)
            if view.has(other=name == "b")
        ]

    def replace_run(self, run: Run) -> None:
        """Show a newer state of the recording; the whole of it, if that was shown."""
        all_of_it = self.window == self.whole
        self._show([run])
        if all_of_it:
            self.window = self.whole

    def lanes(
        self, view: View, place: int, selected: tuple[int, int] | None, columns: int
    ) -> Lanes:
        """Return the lanes with the selected event, which is at ``place``, in sight."""
        if self.window.order:
            self.window = _around(self.window, place, columns, view.count)
        elif selected is not None:
            maker = self.makers[selected[0]]
            self.window = maker.centred(self.window, selected[1], columns)
        known = tuple(maker.summaries for maker in self.makers)
        shown = [view.has(other=other) for other in (False, True)]
        key = (self.window, columns, known, shown, place if self.window.order else -1)
        if self._made is None or self._made[0] != key:
            make = self._by_place if self.window.order else self._by_time
            self._made = key, make(view, selected, columns)
        return self._made[1]

    def zoom(self, step: int, selected: tuple[int, int] | None, columns: int) -> None:
        """Zoom in (1), out (-1), or to all there is (0)."""
        if step == 0 or selected is None:
            self.window = self.whole
        else:
            maker = self.makers[selected[0]]
            self.window = maker.zoomed(self.window, step, selected[1], columns)

    def _by_time(self, view: View, selected: tuple[int, int] | None, columns: int) -> Lanes:
        window = self.window.fitted(columns)
        counted = [(name, maker.count(window, columns)) for name, maker in self._shown(view)]
        return drawn(window, columns, counted)

    def _by_place(self, view: View, selected: tuple[int, int] | None, columns: int) -> Lanes:
        cause = None
        if selected is not None:
            found = int(self._runs[selected[0]].row(selected[1])["cause_event"])
            if found < self._runs[selected[0]].count:
                cause = view.place_of(found, other=bool(selected[0]))
        last = min(self.window.end, view.count)
        made = []
        for name, maker in self._shown(view):
            index = view.b if name == "b" else view.a
            indexes = [index(place) for place in range(self.window.start, last)]
            made.append((name, maker.letters(columns, indexes)))
        return lettered(self.window, columns, made, cause)


def _around(window: Window, place: int, columns: int, count: int) -> Window:
    """Return a window of as many places as there are columns, with room beside ``place``."""
    length = max(columns, 1)
    margin = length // 8
    if window.length == length and window.start + margin <= place < window.end - margin:
        return window
    start = max(0, min(place - length // 2, count - length))
    return Window(start, start + length, order=True)
