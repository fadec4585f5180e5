"""Counting the events of nodes in columns of time, for any window of a run, however long.

Of each segment a small summary is kept (when events of an entity begin, in a few pieces of the
segment's time, and how many), made when there is time for it. A window over many segments is drawn
from the summaries that exist; one over a few segments from the events themselves. The deepest zoom
has one event per column, in order: time stands still at one instant, order does not. The window
follows the selected event, and zooms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventFlag, EventKind
from rsltrace.trace.words.entities import RUN_NAME
from rsltrace_viewer.model.lanes import KIND_LETTERS, Counted, Lanes, Lettered, drawn, lettered
from rsltrace_viewer.model.run import Run, Segment
from rsltrace_viewer.model.view import Floats, View, Window, ends_of, spread, step_below, step_from

_EXACT_SEGMENTS = 6
_PIECES_MAX = 32
_PIECES_PER_SEGMENT = 1024
_SLOTS_MAX = 512
"""Entities that are counted one by one; what more a node has is counted together."""

_LETTERS = {int(kind): letter for kind, letter in KIND_LETTERS.items()}


class LaneMaker:
    """Counts the events of a run's nodes in any window."""

    def __init__(self, run: Run) -> None:
        self._run = run
        first_ns = run.start_ns - run.base_ns
        self.whole = Window(first_ns, max(run.end_ns - run.base_ns, first_ns) + 1)
        """The window of the whole run. Windows of time count from the start of the run."""
        self.labels = [*(node.name for node in run.nodes), RUN_NAME]
        self._slots, self._row_of_slot = _slots(run)
        slots = len(self._row_of_slot)
        self._pieces = max(1, min(_PIECES_MAX, _PIECES_PER_SEGMENT // slots))
        count = len(run.segments)
        self._counts = np.zeros((count, slots, self._pieces), dtype=np.uint16)
        self._starts = np.zeros((count, slots, self._pieces), dtype=np.float32)
        self._known = np.zeros(count, dtype=np.bool_)
        self._signs: dict[str, list[tuple[int, int]]] = {"!": [], "w": [], "g": []}
        self._sorted_signs: dict[str, npt.NDArray[np.int64]] = {}
        self.summaries = 0
        """How much is known: lanes of the same window may differ by it."""

    def order(self) -> list[int]:
        """Return segment numbers in an order that fills an overview evenly: coarse, then fine."""
        count = len(self._run.segments)
        step = 1 << max(count - 1, 1).bit_length()
        seen: list[int] = []
        done = np.zeros(count, dtype=np.bool_)
        while step:
            for number in range(0, count, step):
                if not done[number]:
                    done[number] = True
                    seen.append(number)
            step //= 2
        return seen

    def known(self, number: int) -> bool:
        """Return whether segment ``number`` has its summary."""
        return bool(self._known[number])

    def add_signs(self, sign: str, found: Sequence[tuple[int, int]]) -> None:
        """Show a sign at (time in ns, row of the node) each: ``w`` or ``g``."""
        self._signs[sign] += found
        self._sorted_signs.pop(sign, None)
        self.summaries += 1

    def summarise(self, number: int) -> None:
        """Make the summary of a segment. One that cannot be read stays empty."""
        if self._known[number]:
            return
        try:
            segment = self._run.segment(number)
        except TraceError:
            self._known[number] = True
            self.summaries += 1
            return
        row = self._run.segments[number]
        start, end = int(row["start_stamp"]), int(row["end_stamp"])
        slots = self._slots_of(segment)
        since = (segment.events["stamp"] - np.uint64(start)).astype(np.float64)
        pieces = np.minimum(since * self._pieces / (end - start + 1), self._pieces - 1)
        flat = slots * self._pieces + pieces.astype(np.int64)
        counts = np.bincount(flat, minlength=self._counts[number].size)
        self._counts[number] = np.minimum(counts, 65535).reshape(self._counts[number].shape)
        self._starts[number].reshape(-1)[flat[::-1]] = since[::-1]  # the first of each one stays
        raised = (segment.events["flags"] & int(EventFlag.RAISED)) != 0
        if raised.any():
            rows = self._row_of_slot[slots[raised]]
            stamps = segment.events["stamp"][raised].astype(np.int64)
            self.add_signs("!", list(zip(stamps.tolist(), rows.tolist(), strict=True)))
        self._known[number] = True
        self.summaries += 1

    def count(self, window: Window, columns: int) -> Counted:
        """Return the events in a window of time that fits ``columns`` (``Window.fitted``)."""
        base_ns = self._run.base_ns
        window = Window(window.start + base_ns, window.end + base_ns)
        numbers = self._overlapping(window)
        exact = len(numbers) <= _EXACT_SEGMENTS
        known = 1.0 if exact else float(self._known[numbers].mean())
        entries = self._from_events(numbers) if exact else self._from_summaries(numbers, columns)
        counts = np.zeros((len(self.labels), columns))
        step = window.step(columns)
        for slot, (stamps, numbers_there) in entries.items():
            starts = (stamps - window.start).astype(np.float64)
            ends = ends_of(starts, numbers_there)
            counts[self._row_of_slot[slot]] += spread(
                starts, ends, numbers_there, step, columns, exact=exact
            )
        return Counted(self.labels, counts, self._signs_in(window, columns), known)

    def letters(self, columns: int, indexes: Sequence[int | None]) -> Lettered:
        """Return the events with these indexes, a column each; None leaves one free."""
        run = self._run
        lines = [[" "] * columns for _ in self.labels]
        signs: list[dict[int, str]] = [{} for _ in self.labels]
        for column, index in enumerate(indexes[:columns]):
            if index is None or not 0 <= index < run.count:
                continue
            try:
                event = run.row(index)
            except TraceError:
                continue
            row = self.row_of(int(event["entity"]))
            lines[row][column] = _LETTERS.get(int(event["kind"]), "?")
            if int(event["flags"]) & EventFlag.RAISED:
                signs[row][column] = "!"
        return Lettered(self.labels, ["".join(line) for line in lines], signs)

    def zoomed(self, window: Window, step: int, selected: int, columns: int) -> Window:
        """Return the window after zooming in (``step`` 1) or out (-1) around event ``selected``."""
        run = self._run
        if window.order:
            if step > 0:
                return window
            narrowest = step_from(self._narrowest(selected, columns))
            return self._around(self._since_start(selected), narrowest, columns)
        shown = window.fitted(columns).step(columns)
        length = step_below(shown) if step > 0 else step_from(shown + 1)
        if step > 0 and (length == shown or length < self._narrowest(selected, columns)):
            return Window(0, columns, order=True)
        return self._around(self._since_start(selected) if run.count else 0, length, columns)

    def centred(self, window: Window, selected: int, columns: int) -> Window:
        """Return a window of time moved so that event ``selected`` is in it."""
        if not self._run.count or window == self.whole:
            return window
        stamp = self._since_start(selected)
        fitted = window.fitted(columns)
        if fitted.start <= stamp < fitted.end:
            return window
        return self._around(stamp, fitted.step(columns), columns)

    def _since_start(self, event: int) -> int:
        return self._run.stamp(event) - self._run.base_ns

    def _around(self, stamp: int, step: int, columns: int) -> Window:
        whole = self.whole
        if step * columns >= whole.length:
            return whole
        start = min(stamp - step * (columns // 2), whole.end - step * (columns - 1))
        start = max(start, whole.start) // step * step
        return Window(start, start + step * columns)

    def _narrowest(self, selected: int, columns: int) -> int:
        """Return the length of a column if as many events as there are columns fill them all."""
        run = self._run
        first = max(selected - columns // 2, 0)
        last = min(first + columns, run.count - 1)
        return max((run.stamp(last) - run.stamp(first)) // max(columns, 1), 1)

    def _overlapping(self, window: Window) -> npt.NDArray[np.int64]:
        segments = self._run.segments
        inside = (segments["end_stamp"] >= np.uint64(max(window.start, 0))) & (
            segments["start_stamp"] < np.uint64(max(window.end, 0))
        )
        return np.flatnonzero(inside)

    def row_of(self, entity: int) -> int:
        return int(self._row_of_slot[self._slots[min(entity, len(self._slots) - 1)]])

    def _slots_of(self, segment: Segment) -> npt.NDArray[np.int64]:
        entities = np.minimum(segment.events["entity"], len(self._slots) - 1)
        own = self._slots[entities]
        # What goes on after a wait comes right after what began it: another rhythm.
        resumed = segment.events["kind"] == int(EventKind.RESUME)
        return np.asarray(np.where(resumed, self._row_of_slot[own] + len(self.labels), own))

    def _from_events(
        self, numbers: npt.NDArray[np.int64]
    ) -> dict[int, tuple[npt.NDArray[np.int64], Floats]]:
        """Return, by slot, the instants of its events in some segments and how many there are in
        each. The segments beside are read, too: a gap at the edge has its length."""
        slots, stamps = [], []
        for number in self._and_beside(numbers):
            try:
                segment = self._run.segment(number)
            except TraceError:
                continue
            slots.append(self._slots_of(segment))
            stamps.append(segment.events["stamp"].astype(np.int64))
        if not slots:
            return {}
        slot, stamp = np.concatenate(slots), np.concatenate(stamps)
        order = np.lexsort((stamp, slot))
        slot, stamp = slot[order], stamp[order]
        new = np.append(True, (np.diff(slot) != 0) | (np.diff(stamp) != 0))
        first = np.flatnonzero(new)
        counts = np.diff(np.append(first, len(slot))).astype(np.float64)
        return _by_slot(slot[first], stamp[first], counts)

    def _from_summaries(
        self, numbers: npt.NDArray[np.int64], columns: int
    ) -> dict[int, tuple[npt.NDArray[np.int64], Floats]]:
        """Return what ``_from_events`` does, as far as the summaries tell."""
        beside = np.array(self._and_beside(numbers), dtype=np.int64)
        beside = beside[self._known[beside]]
        bases = self._run.segments["start_stamp"][beside].astype(np.int64)
        found = {}
        for slot in range(len(self._row_of_slot)):
            counts = self._counts[beside, slot]
            starts = self._starts[beside, slot]
            if len(beside) > 2 * columns:  # finer than columns: one entry per segment will do
                there = counts.any(axis=1)
                first = np.argmax(counts > 0, axis=1)
                starts = starts[np.arange(len(beside)), first]
                counts = counts.sum(axis=1)
                stamps = bases + starts.astype(np.int64)
            else:
                there = counts > 0
                stamps = bases[:, None] + starts.astype(np.int64)
            if there.any():
                found[slot] = stamps[there], counts[there].astype(np.float64)
        return found

    def _and_beside(self, numbers: npt.NDArray[np.int64]) -> list[int]:
        if not len(numbers):
            return []
        first, last = int(numbers[0]), int(numbers[-1])
        return list(range(max(first - 1, 0), min(last + 2, len(self._run.segments))))

    def _signs_in(self, window: Window, columns: int) -> list[Mapping[int, str]]:
        found: list[dict[int, str]] = [{} for _ in self.labels]
        step = window.step(columns)
        for sign in ("g", "w", "!"):  # the worst is what one sees
            pairs = self._sorted_signs.get(sign)
            if pairs is None:
                pairs = np.array(sorted(self._signs[sign]), dtype=np.int64).reshape(-1, 2)
                self._sorted_signs[sign] = pairs
            low, high = np.searchsorted(pairs[:, 0], [window.start, window.end])
            if low == high:
                continue
            places = (pairs[low:high, 0] - window.start) // step
            for row, column in np.unique(np.stack((pairs[low:high, 1], places)), axis=1).T.tolist():
                found[row][column] = sign
        return list(found)


def _by_slot(
    slots: npt.NDArray[np.int64], stamps: npt.NDArray[np.int64], counts: Floats
) -> dict[int, tuple[npt.NDArray[np.int64], Floats]]:
    names, first = np.unique(slots, return_index=True)
    bounds = [*first.tolist(), len(slots)]
    return {
        slot: (stamps[bounds[place] : bounds[place + 1]], counts[bounds[place] : bounds[place + 1]])
        for place, slot in enumerate(names.tolist())
    }


_ONE_BY_ONE = (EntityKind.TIMER, EntityKind.SUBSCRIPTION, EntityKind.SERVICE, EntityKind.CLIENT)


def _slots(run: Run) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the slot of each entity by its id, and the row (node) of each slot. The first slots
    are those of the nodes, for what is not counted one by one; then one for what each resumes."""
    nodes = run.entity_node
    rows = len(run.nodes) + 1
    slots = np.where(nodes < 0, rows - 1, nodes)
    row_of_slot = [*range(rows), *range(rows)]
    for entity in run.entities.values():
        if entity.kind in _ONE_BY_ONE and len(row_of_slot) < 2 * rows + _SLOTS_MAX:
            row = int(slots[entity.id])
            slots[entity.id] = len(row_of_slot)
            row_of_slot.append(row)
    return slots, np.array(row_of_slot, dtype=np.int64)


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
