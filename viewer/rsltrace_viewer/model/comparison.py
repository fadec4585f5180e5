"""Two runs next to each other: which events belong together, what differs in them, and why.

Up to the first difference a place is an event of both runs and nothing is read. From there on
events are matched by the diff, a block at a time, as far as one has come; what has not been
matched yet stands at the end, unmatched, and says so.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterator

from rsltrace.diff.alignment.blocks import AlignedBlock, AlignedBlocks, EventPair
from rsltrace.diff.alignment.entity_matching import match_entities
from rsltrace.diff.alignment.first_difference import first_difference
from rsltrace.diff.alignment.rows import Run as DiffRun
from rsltrace.diff.causes.effects import first_effect, is_setup
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import Diff
from rsltrace.diff.traces.comparison import first_item
from rsltrace.diff.traces.diff import diff_traces
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.view import Sign
from rsltrace_viewer.model.windows import Window

_EVENTS_PER_BLOCK = 2000
_ALIGNED_MAX = 2_000_000
"""Events after the first difference that are matched; beyond, rows are not compared."""

_SIGNS = tuple(Sign)
_CODES = {sign: code for code, sign in enumerate(_SIGNS)}
_UNMATCHED = -1


class Comparison:
    """The view of two runs (see ``View``). ``advance`` matches another block."""

    def __init__(self, a: Run, b: Run) -> None:
        """Find the first difference and match the events around it. Raises TraceError."""
        self.run_a = a
        self.run_b = b
        self.diff: Diff | None = None
        self._whole = a.trace.complete and b.trace.complete
        first = first_difference(a.trace, b.trace)
        self.agreeing = a.count if first is None else first
        self.done = first is None
        self._a = array("q")
        self._b = array("q")
        self._signs = array("B")
        self._place_a = array("q")
        self._place_b = array("q")
        self._divergences: list[int] = []
        """Places where rows begin to differ, after one that does not."""
        self._divergence_stamps: list[int] = []
        """When that was, in the order of times: one that moved is listed by the earlier of two."""
        self.shifted = False
        """Whether an event is known that both runs have, but not at the same time."""
        self._first_place: int | None = None if first is None else first
        self._end_a = self._end_b = self.agreeing
        self._aligned_blocks: Iterator[AlignedBlock] = iter(())
        matching = match_entities(a.trace, b.trace)
        self.diff_run_a = DiffRun(a.trace, matching, False)
        self.diff_run_b = DiffRun(b.trace, matching, True)
        if first is not None:
            blocks = AlignedBlocks(self.diff_run_a, self.diff_run_b, first, _EVENTS_PER_BLOCK)
            self._aligned_blocks = (part for part in blocks if isinstance(part, AlignedBlock))
            block = self.fetch()
            self.take(block)
            self._first_place = self._divergences[0] if self._divergences else first
            # Where nodes were set up otherwise, what they then do is what one wants to see.
            if block is not None and is_setup(block, first_item(block, first)):
                effect = first_effect(block)
                if effect is not None:
                    index = effect.a if effect.a >= 0 else effect.b
                    self._first_place = self.place_of(index, other=effect.a < 0)

    # The view.

    @property
    def count(self) -> int:
        """How many places there are."""
        rest = max(self.run_a.count - self._end_a, self.run_b.count - self._end_b)
        return self.agreeing + len(self._a) + rest

    def a(self, place: int) -> int | None:
        """Return the index of the event of run a at a place."""
        return self._index(place, self._a, self._end_a, self.run_a.count)

    def b(self, place: int) -> int | None:
        """Return the index of the event of run b at a place."""
        return self._index(place, self._b, self._end_b, self.run_b.count)

    def sign(self, place: int) -> Sign:
        """Return how the two compare."""
        if place < self.agreeing:
            return Sign.MATCH
        matched = place - self.agreeing
        return _SIGNS[self._signs[matched]] if matched < len(self._signs) else Sign.UNKNOWN

    def place_of(self, index: int, *, other: bool = False) -> int:
        """Return the place of an event of run a (``other``: of run b)."""
        if index < self.agreeing:
            return index
        places, end = (self._place_b, self._end_b) if other else (self._place_a, self._end_a)
        matched = index - self.agreeing
        if matched < len(places) and places[matched] >= 0:
            return places[matched]
        return self.agreeing + len(self._a) + max(index - end, 0)

    def _index(self, place: int, matched: array[int], end: int, count: int) -> int | None:
        if place < self.agreeing:
            return place
        offset = place - self.agreeing
        if offset < len(matched):
            index = matched[offset]
            return index if index >= 0 else None
        index = end + offset - len(matched)
        return index if index < count else None

    # Matching.

    @property
    def progress(self) -> float:
        """The part of both runs that is matched, 0 to 1."""
        total = self.run_a.count + self.run_b.count
        return 1.0 if self.done else (self._end_a + self._end_b) / max(total, 1)

    def advance(self) -> None:
        """Match the next block."""
        self.take(self.fetch())

    def fetch(self) -> AlignedBlock | None:
        """Match the next block without showing it yet, in any thread. Raises TraceError."""
        return next(self._aligned_blocks, None)

    def take(self, block: AlignedBlock | None) -> None:
        """Show a block (None: there is no more)."""
        if block is None:
            self.done = True
            return
        for item in block.items:
            self._add(item, _sign(item, block), block.stamp(item))
            if item.a >= 0 and item.b >= 0 and not self.shifted:
                stamp_b = block.rows_b.stamp[item.b - block.rows_b.first]
                self.shifted = stamp_b != block.stamp(item)
        self._end_a, self._end_b = block.end_a, block.end_b
        self.done = block.at_end or len(self._a) > _ALIGNED_MAX

    def _add(self, item: EventPair, sign: Sign, stamp_ns: int) -> None:
        place = self.agreeing + len(self._a)
        plain = sign is Sign.MATCH
        if not plain and (not self._signs or self._signs[-1] == _CODES[Sign.MATCH]):
            self._divergences.append(place)
            insort(self._divergence_stamps, stamp_ns)
        self._a.append(item.a)
        self._b.append(item.b)
        self._signs.append(_CODES[sign])
        _enter(self._place_a, item.a - self.agreeing, place)
        _enter(self._place_b, item.b - self.agreeing, place)

    def finish_diff(self) -> None:
        """Let the diff say why the runs diverge. Takes a while; meant for a thread."""
        self.diff = diff_traces(self.run_a.trace, self.run_b.trace, DiffOptions())

    # What it says.

    @property
    def identical(self) -> bool:
        """Whether the runs did the same (of recordings that are cut nobody knows)."""
        return self._first_place is None and self._whole

    @property
    def first_place(self) -> int | None:
        """The place of the first difference that is an effect; None if nothing differs."""
        return self._first_place

    def verdict(self) -> str:
        """Return in one sentence how the runs compare."""
        if self.identical:
            return f"= identical: all {self.run_a.count:,} events are the same"
        if self.diff is not None:
            sign = "~" if self.diff.agrees_until_cut else "≠"
            return f"{sign} {self.diff.verdict.value}: {self.diff.sentence}"
        return f"≠ the runs agree for {self.agreeing:,} events; looking for the cause …"

    def divergences_in(self, window: Window, columns: int) -> tuple[int | None, frozenset[int]]:
        """Return the column of the first divergence (None: none), and those of all in a window."""
        at = self._divergences if window.order else self._divergence_stamps
        low, high = bisect_left(at, window.start), bisect_left(at, window.end)
        found = frozenset(window.column(position, columns) for position in at[low:high])
        if self._first_place is None or not at:
            return None, found
        return window.column(at[0], columns), found

    def next_divergence(self, place: int, step: int) -> int | None:
        """Return where the runs next begin to differ after (or before) a place."""
        if step > 0:
            found = bisect_right(self._divergences, place)
        else:
            found = bisect_left(self._divergences, place) - 1
        return self._divergences[found] if 0 <= found < len(self._divergences) else None


def _sign(item: EventPair, block: AlignedBlock) -> Sign:
    if item.b < 0:
        return Sign.ONLY_A
    if item.a < 0:
        return Sign.ONLY_B
    if item.plain:
        return Sign.MATCH
    if item.same:
        return Sign.MOVED
    a, b = block.rows_a, block.rows_b
    i, j = item.a - a.first, item.b - b.first
    did_the_same = (a.input[i], a.content[i], a.flags[i]) == (b.input[j], b.content[j], b.flags[j])
    did_the_same = did_the_same and a.state[i] == b.state[j]
    return Sign.MOVED if did_the_same else Sign.DIFFERS


def _enter(places: array[int], offset: int, place: int) -> None:
    """Note a place by index. What lies between was matched earlier, or will be later."""
    if offset < 0:
        return
    while len(places) <= offset:
        places.append(_UNMATCHED)
    places[offset] = place
