"""How busy every node was over time: counts of events in columns, for the lanes.

Of each segment a small summary is kept (events per node in a few pieces of its time), made when
there is time for it. A window over many segments is drawn from the summaries that exist; one over
a few segments from the events themselves. The deepest zoom has one event per column, in order:
time stands still at one instant, order does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.model.event import NO_EVENT, EventFlag, EventKind
from rsltrace.words.entities import RUN_NAME
from rsltrace_viewer.model.run import Run, Segment

_EXACT_SEGMENTS = 6
_PIECES_MAX = 32
_ZOOM = 2
LEVELS = 8
"""Heights of a cell; 0 is empty."""

KIND_LETTERS = {
    EventKind.CONSTRUCT: "I",
    EventKind.TIMER: "T",
    EventKind.SUBSCRIPTION: "s",
    EventKind.SERVICE: "V",
    EventKind.CLIENT: "c",
    EventKind.GUARD_CONDITION: "g",
    EventKind.TASK: "t",
    EventKind.RESUME: "r",
    EventKind.QOS_EVENT: "q",
    EventKind.BAG: "B",
    EventKind.SHUTDOWN: "E",
    EventKind.ACTION: "a",
    EventKind.CLOCK_JUMP: "J",
    EventKind.OUTSIDE: "O",
}


@dataclass(frozen=True, slots=True)
class Window:
    """What the lanes show. ``order``: event indexes; otherwise ns. ``end`` is not included."""

    start: int
    end: int
    order: bool = False

    @property
    def length(self) -> int:
        """In ns, or in events."""
        return self.end - self.start

    def column(self, position: int, columns: int) -> int:
        """Return the column of a time (or index); may lie outside of 0 … columns - 1."""
        return (position - self.start) * columns // max(self.length, 1)

    def at(self, column: int, columns: int) -> int:
        """Return the time (or index) at the left edge of a column."""
        # Rounded up, so that column(at(c)) is c.
        return self.start - (-column * self.length // max(columns, 1))


@dataclass(frozen=True, slots=True)
class Lane:
    """One node. ``levels``: height 0 … LEVELS per column; ``letters`` instead where one event is
    one column; ``raised``: columns with an exception."""

    label: str
    levels: tuple[int, ...]
    raised: frozenset[int] = frozenset()
    letters: str = ""


@dataclass(frozen=True, slots=True)
class Lanes:
    """All lanes of a window. ``known`` is the part of its segments that was read, 0 to 1.

    ``cause`` is the column of the event that caused the selected one, where each has its own.
    """

    window: Window
    columns: int
    lanes: tuple[Lane, ...]
    known: float = 1.0
    cause: int | None = None


class LaneMaker:
    """Makes lanes for any window of a run."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self.labels = [*(node.name for node in run.nodes), RUN_NAME]
        rows = len(self.labels)
        self._pieces = max(4, min(_PIECES_MAX, 2048 // rows))
        count = len(run.segments)
        self._counts = np.zeros((count, rows, self._pieces), dtype=np.uint16)
        self._raised = np.zeros((count, rows, self._pieces), dtype=np.bool_)
        self._known = np.zeros(count, dtype=np.bool_)
        self.summaries = 0
        """How many segments have their summary: lanes of the same window may differ by it."""

    @property
    def whole(self) -> Window:
        """The window of the whole run."""
        run = self._run
        return Window(run.start_ns, max(run.end_ns + 1, run.start_ns + 1))

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

    def summarise(self, number: int) -> None:
        """Make the summary of a segment. One that cannot be read stays empty."""
        if self._known[number]:
            return
        try:
            segment = self._run.segment(number)
        except TraceError:
            self._done(number)
            return
        row = self._run.segments[number]
        start, end = int(row["start_stamp"]), int(row["end_stamp"])
        window = Window(start, end + 1)
        counts, raised = self._bin(segment, window, self._pieces)
        self._counts[number] = np.minimum(counts, 65535)
        self._raised[number] = raised
        self._done(number)

    def _done(self, number: int) -> None:
        self._known[number] = True
        self.summaries += 1

    def make(self, window: Window, columns: int, selected: int = -1) -> Lanes:
        """Return the lanes of a window in ``columns`` cells."""
        if window.order:
            return self._ordered(window, columns, selected)
        numbers = self._overlapping(window)
        if len(numbers) <= _EXACT_SEGMENTS:
            counts = np.zeros((len(self.labels), columns), dtype=np.int64)
            raised = np.zeros_like(counts, dtype=np.bool_)
            for number in numbers.tolist():
                try:
                    more, more_raised = self._bin(self._run.segment(number), window, columns)
                except TraceError:
                    continue
                counts += more
                raised |= more_raised
            known = 1.0
        else:
            counts, raised = self._from_summaries(numbers, window, columns)
            known = float(self._known[numbers].mean())
        return self._lanes(window, columns, counts, raised, known)

    def zoomed(self, window: Window, step: int, selected: int, columns: int) -> Window:
        """Return the window after zooming in (``step`` 1) or out (-1) around event ``selected``."""
        run = self._run
        if window.order:
            if step > 0:
                return self.centred(window, selected, columns)
            return self._around(run.stamp(selected), self._narrowest(selected, columns) * _ZOOM)
        length = window.length // _ZOOM if step > 0 else window.length * _ZOOM
        if step > 0 and length <= self._narrowest(selected, columns):
            return self.centred(Window(0, columns, order=True), selected, columns)
        return self._around(run.stamp(selected) if run.count else 0, length)

    def centred(self, window: Window, selected: int, columns: int) -> Window:
        """Return ``window`` moved so that event ``selected`` is in it, with room on both sides."""
        if not self._run.count:
            return window
        if window.order:
            length = max(columns, 1)
            margin = length // 8
            if window.length == length and (
                window.start + margin <= selected < window.end - margin
            ):
                return window
            start = max(0, min(selected - length // 2, self._run.count - length))
            return Window(start, start + length, order=True)
        stamp = self._run.stamp(selected)
        if window.start <= stamp < window.end:
            return window
        return self._around(stamp, window.length)

    def _around(self, stamp: int, length: int) -> Window:
        whole = self.whole
        if length >= whole.length:
            return whole
        start = max(whole.start, min(stamp - length // 2, whole.end - length))
        return Window(start, start + length)

    def _narrowest(self, selected: int, columns: int) -> int:
        """Return the time that as many events around ``selected`` take as there are columns."""
        run = self._run
        first = max(selected - columns // 2, 0)
        last = min(first + columns, run.count - 1)
        return max(run.stamp(last) - run.stamp(first), 1)

    def _overlapping(self, window: Window) -> npt.NDArray[np.int64]:
        segments = self._run.segments
        inside = (segments["end_stamp"] >= np.uint64(max(window.start, 0))) & (
            segments["start_stamp"] < np.uint64(max(window.end, 0))
        )
        return np.flatnonzero(inside)

    def _rows_of(self, segment: Segment) -> npt.NDArray[np.int64]:
        table = self._run.entity_node
        entities = np.minimum(segment.events["entity"], len(table) - 1)
        rows = table[entities]
        return np.where(rows < 0, len(self.labels) - 1, rows)

    def _bin(
        self, segment: Segment, window: Window, columns: int
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        """Return counts and raised, both of shape (nodes + 1, columns)."""
        rows = self._rows_of(segment)
        stamps = segment.events["stamp"].astype(np.int64)
        # In floats: a window of days in ns times columns does not fit into 64 bits.
        places = np.floor((stamps - window.start) / window.length * columns).astype(np.int64)
        inside = (places >= 0) & (places < columns)
        flat = rows[inside] * columns + places[inside]
        shape = (len(self.labels), columns)
        counts = np.bincount(flat, minlength=shape[0] * columns).reshape(shape)
        raised = np.zeros(shape[0] * columns, dtype=np.bool_)
        raised[flat[(segment.events["flags"][inside] & int(EventFlag.RAISED)) != 0]] = True
        return counts, raised.reshape(shape)

    def _from_summaries(
        self, numbers: npt.NDArray[np.int64], window: Window, columns: int
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        numbers = numbers[self._known[numbers]]
        rows = len(self.labels)
        counts = np.zeros((rows, columns), dtype=np.int64)
        raised = np.zeros((rows, columns), dtype=np.bool_)
        starts = self._run.segments["start_stamp"][numbers].astype(np.int64)
        lengths = self._run.segments["end_stamp"][numbers].astype(np.int64) - starts + 1
        middles = (np.arange(self._pieces) + 0.5) / self._pieces
        times = starts[:, None] + lengths[:, None] * middles[None, :]
        places = np.floor((times - window.start) / window.length * columns).astype(np.int64)
        inside = (places >= 0) & (places < columns)
        for row in range(rows):
            counts[row] = np.bincount(
                places[inside], weights=self._counts[numbers, row][inside], minlength=columns
            )[:columns]
            raised[row, places[inside & self._raised[numbers, row]]] = True
        return counts, raised

    def _lanes(
        self,
        window: Window,
        columns: int,
        counts: npt.NDArray[np.int64],
        raised: npt.NDArray[np.bool_],
        known: float,
    ) -> Lanes:
        lanes = []
        most = max(int(np.max(counts, initial=0)), 1)
        for row, label in enumerate(self.labels):
            own = counts[row]
            if label == RUN_NAME and not own.any():
                continue
            # Roots, rounded up: a busy node must not flatten the others, a single event is seen.
            levels = np.ceil(np.sqrt(own / most) * LEVELS).astype(np.int64)
            lanes.append(
                Lane(label, tuple(levels.tolist()), frozenset(np.flatnonzero(raised[row]).tolist()))
            )
        return Lanes(window, columns, tuple(lanes), known)

    def _ordered(self, window: Window, columns: int, selected: int) -> Lanes:
        run = self._run
        first, last = max(window.start, 0), min(window.end, run.count)
        letters = [[" "] * columns for _ in self.labels]
        raised: list[set[int]] = [set() for _ in self.labels]
        if first < last:
            for number in range(run.segment_of(first), run.segment_of(last - 1) + 1):
                try:
                    segment = run.segment(number)
                except TraceError:
                    continue
                low, high = max(first, segment.first), min(last, segment.last)
                part = slice(low - segment.first, high - segment.first)
                rows = self._rows_of(segment)[part].tolist()
                kinds = segment.events["kind"][part].tolist()
                flags = segment.events["flags"][part].tolist()
                for place, (row, kind, flag) in enumerate(zip(rows, kinds, flags, strict=True)):
                    column = low - window.start + place
                    letters[row][column] = KIND_LETTERS.get(kind, "?")
                    if flag & EventFlag.RAISED:
                        raised[row].add(column)
        cause = None
        if 0 <= selected < run.count:
            caused_by = int(run.row(selected)["cause_event"])
            if caused_by != NO_EVENT and window.start <= caused_by < window.end:
                cause = caused_by - window.start
        lanes = [
            Lane(label, (), frozenset(columns_raised), "".join(line))
            for label, line, columns_raised in zip(self.labels, letters, raised, strict=True)
            if label != RUN_NAME or "".join(line).strip()
        ]
        return Lanes(window, columns, tuple(lanes), 1.0, cause)
