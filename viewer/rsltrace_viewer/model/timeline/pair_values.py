"""In what the two events of a row differ, with both values: ``/cmd_vel x 0.8 → 0.0``. Read
separately from the rows, as values of one run are."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from rsltrace.diff.sentences.event_differences import event_differences_text
from rsltrace.errors import TraceError
from rsltrace.trace.model.texts import printable

if TYPE_CHECKING:
    from rsltrace.diff.traces.aligned_runs import AlignedRuns

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
