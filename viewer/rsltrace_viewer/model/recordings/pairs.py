"""The messages of a topic in two recordings, next to each other: which belong together."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np
import numpy.typing as npt

from rsltrace.diff.bags.sequences import gaps_by_order
from rsltrace.diff.row_sign import Sign
from rsltrace_viewer.model.recordings.recording import Topic

_NONE = -1


class Pairs:
    """Rows of a topic. ``a`` and ``b`` are the numbers of messages, -1 for none, shape (rows,)."""

    def __init__(self, a: Topic | None, b: Topic | None) -> None:
        count_a = len(a.stamps) if a is not None else 0
        count_b = len(b.stamps) if b is not None else 0
        self.a: npt.NDArray[np.int64]
        self.b: npt.NDArray[np.int64]
        if a is None or b is None:
            count = max(count_a, count_b)
            numbers, none = np.arange(count), np.full(count, _NONE)
            self.a, self.b = (numbers, none) if a is not None else (none, numbers)
            self.differs = np.ones(count, dtype=np.bool_)
            return
        parts_a, parts_b, differs = [], [], []
        at_a = at_b = 0
        end = (count_a, count_a, count_b, count_b)
        for a_start, a_end, b_start, b_end in [*gaps_by_order(a.keys, b.keys), end]:
            equal = a_start - at_a
            long = max(a_end - a_start, b_end - b_start)
            parts_a += [np.arange(at_a, a_start), _padded(a_start, a_end, long)]
            parts_b += [np.arange(at_b, at_b + equal), _padded(b_start, b_end, long)]
            differs += [np.zeros(equal, dtype=np.bool_), np.ones(long, dtype=np.bool_)]
            at_a, at_b = a_end, b_end
        self.a, self.b = np.concatenate(parts_a), np.concatenate(parts_b)
        self.differs = np.concatenate(differs)

    def of_masks(self, masks: Sequence[npt.NDArray[np.bool_]]) -> npt.NDArray[np.bool_]:
        """Return the rows with a message for which the mask of its recording says yes."""
        found = np.zeros(self.count, dtype=np.bool_)
        for places, mask in zip((self.a, self.b), masks, strict=False):
            there = places >= 0
            found[there] |= mask[places[there]]
        return found

    def only(self, rows: npt.NDArray[np.bool_]) -> Pairs:
        """Return these rows alone."""
        found = copy(self)
        found.a, found.b, found.differs = self.a[rows], self.b[rows], self.differs[rows]
        return found

    @property
    def count(self) -> int:
        """How many rows there are."""
        return len(self.a)

    def at(self, row: int) -> tuple[int | None, int | None]:
        """Return the numbers of the messages in a row."""
        a, b = int(self.a[row]), int(self.b[row])
        return (a if a >= 0 else None), (b if b >= 0 else None)

    def row_of(self, at: tuple[int | None, int | None]) -> int | None:
        """Return the row with the messages of these numbers (None: whatever there is)."""
        there = np.ones(self.count, dtype=np.bool_)
        for places, number in zip((self.a, self.b), at, strict=True):
            if number is not None:
                there &= places == number
        rows = np.flatnonzero(there)
        return int(rows[0]) if len(rows) else None

    def sign(self, row: int) -> Sign:
        """Return how a row compares, as far as its bytes tell."""
        a, b = self.at(row)
        if a is None or b is None:
            return Sign.ONLY_B if a is None else Sign.ONLY_A
        return Sign.DIFFERS if self.differs[row] else Sign.MATCH

    def next_difference(self, row: int, step: int) -> int | None:
        """Return the row after (or before) this one where rows begin to differ."""
        starts = np.flatnonzero(self.differs & ~np.append(False, self.differs[:-1]))
        found = starts[starts > row] if step > 0 else starts[starts < row]
        if not len(found):
            return None
        return int(found[0] if step > 0 else found[-1])


def _padded(start: int, end: int, length: int) -> npt.NDArray[np.int64]:
    return np.append(np.arange(start, end), np.full(length - (end - start), _NONE))
