"""Two runs next to each other as the viewer shows them: their aligned rows, and why they differ."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence

import numpy as np

from rsltrace.diff.alignment.aligned_rows import AlignedRow
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import Diff
from rsltrace.diff.row_sign import RowSign
from rsltrace.diff.sentences.event_differences import event_differences_text
from rsltrace.diff.traces.aligned_runs import AlignedRuns
from rsltrace.diff.traces.diff import diff_traces
from rsltrace.errors import TraceError
from rsltrace.trace.model.texts import printable
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.view import Ints, View, Window


class Comparison:
    """The view of two runs (see ``View``). ``runs`` aligns more of them, a block at a time."""

    def __init__(self, a: Run, b: Run) -> None:
        """Find the first difference and align the events around it. Raises TraceError."""
        self.run_a = a
        self.run_b = b
        self.diff: Diff | None = None
        self._whole = a.trace.complete and b.trace.complete
        self.runs = AlignedRuns(a.trace, b.trace)
        self.rows = self.runs.rows
        self._stamps: Ints = np.zeros(0, dtype=np.int64)
        """When rows begin to differ, in ns after the start of the run, for as many divergences as
        were known, and sorted."""
        self._stamps_sorted = self._stamps

    # The view.

    @property
    def count(self) -> int:
        return self.rows.count

    @property
    def version(self) -> int:
        """Changes when more is aligned."""
        return self.rows.version

    def row(self, place: int) -> AlignedRow:
        return self.rows.row(place)

    def a(self, place: int) -> int | None:
        """Return the index of the event of run a at a place."""
        return self.rows.row(place).a

    def b(self, place: int) -> int | None:
        """Return the index of the event of run b at a place."""
        return self.rows.row(place).b

    def sign(self, place: int) -> RowSign:
        """Return how the two compare."""
        return self.rows.row(place).sign

    def has(self, *, other: bool) -> bool:
        """Return True: both have places."""
        return True

    def before(self, place: int, *, other: bool = False) -> int:
        """Return how many events of a run have places before this one."""
        return self.rows.before(place, of_b=other)

    def place_of(self, index: int, *, other: bool = False) -> int:
        """Return the place of an event of run a (``other``: of run b)."""
        return self.rows.place_of(index, of_b=other)

    def places_of(self, indexes: Ints, *, other: bool = False) -> Ints:
        return self.rows.places_of(indexes, of_b=other)

    def finish_diff(self) -> None:
        """Let the diff say why the runs diverge. Takes a while; meant for a thread."""
        self.diff = diff_traces(self.run_a.trace, self.run_b.trace, DiffOptions())

    # What it says.

    @property
    def identical(self) -> bool:
        """Whether the runs did the same (of recordings that are cut nobody knows)."""
        return self.first_place is None and self._whole

    @property
    def first_place(self) -> int | None:
        """The place of the first difference that is an effect; None if nothing differs."""
        return self.runs.first_place

    def verdict(self) -> str:
        """Return in one sentence how the runs compare."""
        if self.identical:
            return f"= identical: all {self.run_a.count:,} events are the same"
        if self.diff is not None:
            sign = "~" if self.diff.agrees_until_cut else "≠"
            return f"{sign} {self.diff.verdict.value}: {self.diff.sentence}"
        return f"≠ the runs agree for {self.rows.agreeing:,} events; looking for the cause …"

    def divergences_in(
        self, view: View, window: Window, columns: int
    ) -> tuple[int | None, frozenset[int]]:
        """Return the column of the first divergence (None: none), and those of all in a window."""
        at = self._divergences(view) if window.order else self._divergence_stamps()
        low, high = np.searchsorted(at, [window.start, window.end])
        found = frozenset(window.column(position, columns) for position in at[low:high].tolist())
        if self.first_place is None or not len(at):
            return None, found
        return window.column(int(at[0]), columns), found

    def next_divergence(self, view: View, place: int, step: int) -> int | None:
        """Return where the runs next begin to differ after (or before) a place of ``view``."""
        found = self._divergences(view)
        nth = int(np.searchsorted(found, place, "right" if step > 0 else "left"))
        nth = nth if step > 0 else nth - 1
        return int(found[nth]) if 0 <= nth < len(found) else None

    def _divergences(self, view: View) -> Ints:
        """Return the places of a view where rows begin to differ: of one run, those of its next
        event."""
        rows = self.rows.divergences
        if view is self:
            return rows
        at = self.rows.first_from(rows, of_b=view.has(other=True))
        return np.unique(at[at < view.count])

    def _divergence_stamps(self) -> Ints:
        new = self.rows.divergences[len(self._stamps) :]
        if len(new):
            stamps = np.array([self._stamp(place) for place in new.tolist()], dtype=np.int64)
            self._stamps = np.concatenate((self._stamps, stamps))
            self._stamps_sorted = np.sort(self._stamps)
        return self._stamps_sorted

    def _stamp(self, place: int) -> int:
        row = self.rows.row(place)
        run, index = (self.run_b, row.b or 0) if row.a is None else (self.run_a, row.a)
        return run.stamp(index) - run.base_ns


# In what the two events of a row differ, with both values: ``/cmd_vel x 0.8 → 0.0``. Read apart
# from the rows, as values of one run are.

Pair = tuple[int, int]
_KEPT = 4096


class PairValues:
    """The texts of the pairs of events that have been read so far."""

    def __init__(self, runs: AlignedRuns) -> None:
        self._runs = runs
        self._texts: OrderedDict[Pair, tuple[str, str]] = OrderedDict()

    def known(self, pair: Pair) -> tuple[str, str] | None:
        """Return in what a pair differs, and the same without the names of topics where there is
        only one; None if it has not been read. Empty: in nothing that was recorded."""
        return self._texts.get(pair)

    def read(self, pairs: Sequence[Pair]) -> Iterator[int]:
        """Read pairs, one at a time; yields how many are done."""
        for count, pair in enumerate(pairs, start=1):
            if pair not in self._texts:
                self._texts[pair] = self._read(pair)
                while len(self._texts) > _KEPT:
                    self._texts.popitem(last=False)
            yield count

    def _read(self, pair: Pair) -> tuple[str, str]:
        try:
            found = self._runs.differences(*pair)
            views = self._runs.view(pair[0], of_b=False), self._runs.view(pair[1], of_b=True)
        except TraceError as error:
            text = printable(f"unreadable: {error}")
            return text, text
        whole = event_differences_text(found)
        if not whole and views[0].state_hash != views[1].state_hash:
            whole = "another state afterwards"
        return printable(whole), printable(event_differences_text(found, brief=True))
