"""Two runs as one list of rows: what every picture of two runs is drawn from.

A row has an event of a, an event of b, or the same event of both. Read downwards, the events of a
stand in the order of a, those of b in the order of b, each exactly once. So an event that both runs
have, but elsewhere in the order, has two rows that name each other: it *moved*. Which events stay
is decided by the longest order that both runs share, first among events at the same time.

Up to the first difference row and event are the same number and nothing is kept. From there on the
rows are columns of numbers that grow by a block of matched events at a time; what has not been
matched yet stands at the end, uncompared.

Rejected: one row per matched pair, in the order of a. It cannot show the order of b.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsltrace.diff.alignment.blocks import AlignedBlock, EqualBlock, EventPair
from rsltrace.diff.alignment.rows import longest_increasing
from rsltrace.diff.row_sign import RowSign
from rsltrace.fast_dataclass import dataclass

Ints = npt.NDArray[np.int64]
_NONE = -1
_COLUMN_MIN = 1024
ALIGNED_MAX = 2_000_000
"""Rows after the first difference; beyond, events are not compared."""


_SIGNS = tuple(RowSign)
_MATCH, _DIFFERS, _ONLY_A, _ONLY_B, _MOVED = range(5)
_SIGN_BITS = 7
_SAME_TIME = 8
"""Set beside the sign of a pair: same time and input, so its order says something."""


@dataclass(frozen=True, slots=True)
class AlignedRow:
    """A row: indexes of events, None where a run has none here.

    ``elsewhere`` is the same event in the other run, where that has it in another row.
    """

    a: int | None
    b: int | None
    sign: RowSign
    elsewhere: int | None = None

    @property
    def pair(self) -> tuple[int | None, int | None]:
        """The event in a and in b, wherever they stand."""
        if self.elsewhere is None:
            return self.a, self.b
        return (self.a, self.elsewhere) if self.b is None else (self.elsewhere, self.b)


class _Column:
    """Numbers that become more; what was not entered is -1."""

    def __init__(self) -> None:
        self._room: Ints = np.full(_COLUMN_MIN, _NONE, dtype=np.int64)
        self.count = 0

    @property
    def values(self) -> Ints:
        return self._room[: self.count]

    def put(self, places: Ints, values: Ints) -> None:
        if len(places):
            self.extend_to(int(places.max()) + 1)
            self._room[places] = values

    def append(self, values: Ints) -> None:
        start = self.count
        self.extend_to(start + len(values))
        self._room[start : self.count] = values

    def extend_to(self, count: int) -> None:
        if count > len(self._room):
            more = np.full(max(count, 2 * len(self._room)) - len(self._room), _NONE)
            self._room = np.concatenate((self._room, more))
        self.count = max(self.count, count)

    def at(self, place: int) -> int:
        return int(self._room[place]) if 0 <= place < self.count else _NONE


class _RunRows:
    """What is known of one run. Offsets count from the first difference."""

    def __init__(self, count: int, agreeing: int) -> None:
        self.count = count
        self.end = agreeing
        """The events before this index have their rows."""
        self.rows = _Column()
        """By offset of the row: the index of its event."""
        self.places = _Column()
        """By offset of the event: its row."""
        self.partners = _Column()
        """By offset of the event: the index of the same event in the other run."""
        self.times: Ints = np.zeros(0, dtype=np.int64)
        """When the events from ``end`` on happened, as far as they are matched."""

    @property
    def rest(self) -> int:
        """How many events have no row yet."""
        return self.count - self.end


class AlignedRows:
    """The rows of two runs of ``count_a`` and ``count_b`` events, of which the first ``agreeing``
    are the same. ``take`` adds the events of a block."""

    def __init__(self, count_a: int, count_b: int, agreeing: int) -> None:
        self.agreeing = agreeing
        self.version = 0
        """Changes whenever rows do."""
        self.shifted = False
        """Whether an event is known that both runs have, but not at the same time."""
        self._a, self._b = _RunRows(count_a, agreeing), _RunRows(count_b, agreeing)
        self._signs = _Column()
        self._pairs = _Column()
        """By offset of the event in a: sign and _SAME_TIME of the pair that it is half of."""
        self._divergences = _Column()

    # Rows.

    @property
    def count(self) -> int:
        """How many rows there are."""
        return self._aligned + self._a.rest + self._b.rest

    @property
    def matched(self) -> int:
        """How many rows behind the first difference are aligned."""
        return self._signs.count

    @property
    def progress(self) -> float:
        """The part of both runs that is aligned, 0 to 1."""
        return (self._a.end + self._b.end) / max(self._a.count + self._b.count, 1)

    @property
    def divergences(self) -> Ints:
        """The rows where runs begin to differ, after one in which they do not."""
        return self._divergences.values

    def row(self, place: int) -> AlignedRow:
        """Return a row, which must exist."""
        if place < self.agreeing:
            return AlignedRow(place, place, RowSign.MATCH)
        offset = place - self.agreeing
        if offset >= self.matched:
            a, b = self._unaligned(offset - self.matched)
            return AlignedRow(a, b, RowSign.UNKNOWN)
        a, b = (_index(side.rows.at(offset)) for side in (self._a, self._b))
        elsewhere = None
        if a is None or b is None:
            elsewhere = self.partner(a if a is not None else b or 0, of_b=a is None)
        return AlignedRow(a, b, _SIGNS[self._signs.at(offset)], elsewhere)

    def sign_changes(self) -> tuple[list[int], list[RowSign]]:
        """Return the rows that have another sign than the one before, and their signs."""
        signs = np.concatenate(([_MATCH], self._signs.values))
        changes = np.flatnonzero(signs[1:] != signs[:-1])
        places = [0, *(self.agreeing + changes).tolist()]
        found = [RowSign.MATCH, *(_SIGNS[sign] for sign in signs[1:][changes].tolist())]
        if self.agreeing == 0 and len(changes) and changes[0] == 0:
            places, found = places[1:], found[1:]
        if self._aligned < self.count:
            places, found = [*places, self._aligned], [*found, RowSign.UNKNOWN]
        return places, found

    def partner(self, index: int, *, of_b: bool) -> int | None:
        """Return the index that an event of a (``of_b``: of b) has in the other run."""
        if index < self.agreeing:
            return index
        return _index((self._b if of_b else self._a).partners.at(index - self.agreeing))

    def place_of(self, index: int, *, of_b: bool) -> int:
        """Return the row of an event of a (``of_b``: of b)."""
        return int(self.places_of(np.array([index], dtype=np.int64), of_b=of_b)[0])

    def places_of(self, indexes: Ints, *, of_b: bool) -> Ints:
        """Return the rows of events, in any number."""
        side, other = (self._b, self._a) if of_b else (self._a, self._b)
        places = indexes.astype(np.int64)
        aligned = (places >= self.agreeing) & (places < side.end)
        beyond = places >= side.end
        places[aligned] = side.places.values[places[aligned] - self.agreeing]
        # The runs take turns in what is not compared; then comes what the longer one has more.
        nth = places[beyond] - side.end
        turns = np.minimum(nth, other.rest)
        places[beyond] = self._aligned + nth + turns + (of_b & (nth < other.rest))
        return places

    def before(self, place: int, *, of_b: bool) -> int:
        """Return how many events of a (``of_b``: of b) stand in rows before this one."""
        side, other = (self._b, self._a) if of_b else (self._a, self._b)
        if place <= self._aligned:
            return int(self.first_from(np.array([place], dtype=np.int64), of_b=of_b)[0])
        offset = place - self._aligned
        turns = min(side.rest, other.rest)
        own = (offset + (not of_b)) // 2 if offset < 2 * turns else offset - turns
        return side.end + min(own, side.rest)

    def first_from(self, rows: Ints, *, of_b: bool) -> Ints:
        """Return the first event of a (``of_b``: of b) in each of some aligned rows, or after."""
        side = self._b if of_b else self._a
        places = side.places.values[: side.end - self.agreeing]
        return np.where(rows <= self.agreeing, rows, self.agreeing + np.searchsorted(places, rows))

    @property
    def _aligned(self) -> int:
        return self.agreeing + self.matched

    def _unaligned(self, nth: int) -> tuple[int | None, int | None]:
        a, b = self._a, self._b
        turns = min(a.rest, b.rest)
        if nth < 2 * turns:
            half = nth // 2
            return (None, b.end + half) if nth % 2 else (a.end + half, None)
        half = nth - turns
        return (a.end + half, None) if a.rest > b.rest else (None, b.end + half)

    # Matching.

    def take(self, block: AlignedBlock | EqualBlock) -> None:
        """Add the next block."""
        self.version += 1
        if isinstance(block, EqualBlock):
            self._take_equal(block)
            return
        self._enter(block)
        ends = (block.end_a, block.end_b)
        for side, rows, end in zip(
            (self._a, self._b), (block.rows_a, block.rows_b), ends, strict=True
        ):
            times = np.array(rows.times[: end - rows.first], dtype=np.int64)
            side.times = np.maximum.accumulate(np.concatenate((side.times, times)))
        self._add(block.end_a, block.end_b, last=block.at_end)

    def _take_equal(self, block: EqualBlock) -> None:
        a = np.arange(block.first_a, block.end_a)
        b = np.arange(block.first_b, block.end_b)
        self._pair(a, b, np.full(len(a), _MATCH | _SAME_TIME))
        self._append(a, b, np.full(len(a), _MATCH))
        self._a.end, self._b.end = block.end_a, block.end_b

    def _enter(self, block: AlignedBlock) -> None:
        """Note which events of a block are the same, and how they compare."""
        items = [item for item in block.items if item.a >= 0 and item.b >= 0]
        a = np.array([item.a for item in items], dtype=np.int64)
        b = np.array([item.b for item in items], dtype=np.int64)
        signs = np.array([_sign(item, block) for item in items], dtype=np.int64)
        rows_a, rows_b = block.rows_a, block.rows_b
        i, j = a - rows_a.first, b - rows_b.first
        same_time = np.array(rows_a.stamp)[i] == np.array(rows_b.stamp)[j]
        same_input = (
            np.array(rows_a.input, dtype=np.uint64)[i] == np.array(rows_b.input, dtype=np.uint64)[j]
        )
        self.shifted = self.shifted or not bool(same_time.all())
        self._pair(a, b, signs | np.where(same_time & same_input, _SAME_TIME, 0))

    def _pair(self, a: Ints, b: Ints, pairs: Ints) -> None:
        self._a.partners.put(a - self.agreeing, b)
        self._b.partners.put(b - self.agreeing, a)
        self._pairs.put(a - self.agreeing, pairs)

    def _add(self, end_a: int, end_b: int, *, last: bool) -> None:
        """Make rows of the events up to these. Where an order that both runs share goes on beyond
        the end of the block, they stop before it: the next block has the other half."""
        a, b = np.arange(self._a.end, end_a), np.arange(self._b.end, end_b)
        spine_a, spine_b = self._spine(a, b)
        beyond = np.flatnonzero((spine_a >= end_a) | (spine_b >= end_b))
        if len(beyond):
            first = int(beyond[0])
            if not last:
                end_a, end_b = min(end_a, int(spine_a[first])), min(end_b, int(spine_b[first]))
            spine_a, spine_b = spine_a[:first], spine_b[:first]
            a, b = a[a < end_a], b[b < end_b]
        gap_a, gap_b = np.searchsorted(spine_a, a), np.searchsorted(spine_b, b)
        free_a, free_b = ~np.isin(a, spine_a), ~np.isin(b, spine_b)
        alone_a, alone_b = a[free_a], b[free_b]
        nothing_a, nothing_b = (np.full(len(one), _NONE) for one in (alone_a, alone_b))
        row_a = np.concatenate((alone_a, nothing_b, spine_a))
        row_b = np.concatenate((nothing_a, alone_b, spine_b))
        gap = np.concatenate((gap_a[free_a], gap_b[free_b], np.arange(len(spine_a))))
        time_a = self._a.times[: len(a)][free_a]
        time_b = self._b.times[: len(b)][free_b]
        time = np.concatenate((time_a, time_b, np.zeros(len(spine_a), dtype=np.int64)))
        # In a gap between two shared events by time, those of a first; lexsort keeps their order.
        kind = np.repeat([0, 1, 2], [len(alone_a), len(alone_b), len(spine_a)])
        order = np.lexsort((kind, time, kind == 2, gap))
        row_a, row_b = row_a[order], row_b[order]
        self._append(row_a, row_b, self._signs_of(row_a, row_b))
        self._a.times, self._b.times = self._a.times[len(a) :], self._b.times[len(b) :]
        self._a.end, self._b.end = end_a, end_b

    def _spine(self, a: Ints, b: Ints) -> tuple[Ints, Ints]:
        """Return the events in order that both runs have in the same order: as many as can be of
        those at the same time, then of the others as many as fit between."""
        to_b = self._partners(self._a, a)
        to_a = self._partners(self._b, b)
        here, there = to_b >= self._b.end, to_a >= self._a.end + len(a)
        pair_a, pair_b = (
            np.concatenate((a[here], to_a[there])),
            np.concatenate((to_b[here], b[there])),
        )
        order = np.argsort(pair_a)
        pair_a, pair_b = pair_a[order], pair_b[order]
        sure = (self._pairs.values[pair_a - self.agreeing] & _SAME_TIME) != 0
        chosen = np.flatnonzero(sure)[_increasing(pair_b[sure])]
        fits = np.searchsorted(pair_a[chosen], pair_a) == np.searchsorted(pair_b[chosen], pair_b)
        fits[chosen] = True
        chosen = np.flatnonzero(fits)[_increasing(pair_b[fits])]
        return pair_a[chosen], pair_b[chosen]

    def _partners(self, side: _RunRows, indexes: Ints) -> Ints:
        if len(indexes):
            side.partners.extend_to(int(indexes[-1]) + 1 - self.agreeing)
        return side.partners.values[indexes - self.agreeing]

    def _signs_of(self, row_a: Ints, row_b: Ints) -> Ints:
        both = (row_a >= 0) & (row_b >= 0)
        of_a, of_b = (row_a >= 0) & ~both, (row_b >= 0) & ~both
        mine = row_a.copy()
        mine[of_b] = self._b.partners.values[row_b[of_b] - self.agreeing]
        partner = both.copy()
        partner[of_a] = self._a.partners.values[row_a[of_a] - self.agreeing] >= 0
        partner[of_b] = mine[of_b] >= 0
        signs = np.where(of_a, _ONLY_A, _ONLY_B).astype(np.int64)
        signs[partner] = self._pairs.values[mine[partner] - self.agreeing] & _SIGN_BITS
        signs[partner & ~both & (signs == _MATCH)] = _MOVED
        return signs

    def _append(self, row_a: Ints, row_b: Ints, signs: Ints) -> None:
        start = self._aligned
        places = np.arange(start, start + len(signs))
        for side, rows in ((self._a, row_a), (self._b, row_b)):
            there = rows >= 0
            side.places.put(rows[there] - self.agreeing, places[there])
            side.rows.append(rows)
        differs = signs != _MATCH
        before = self.matched > 0 and self._signs.at(self.matched - 1) != _MATCH
        self._divergences.append(places[differs & ~np.append(before, differs[:-1])[: len(differs)]])
        self._signs.append(signs)


def _sign(item: EventPair, block: AlignedBlock) -> int:
    if item.same:
        return _MATCH
    a, b = block.rows_a, block.rows_b
    i, j = item.a - a.first, item.b - b.first
    did_the_same = (a.input[i], a.content[i], a.flags[i]) == (b.input[j], b.content[j], b.flags[j])
    return _MOVED if did_the_same and a.state[i] == b.state[j] else _DIFFERS


def _increasing(values: Ints) -> Ints:
    """Return the places of as many values as can be that rise from one to the next."""
    if bool((np.diff(values) > 0).all()):
        return np.arange(len(values))
    return np.array(sorted(longest_increasing(values.tolist())), dtype=np.int64)


def _index(value: int) -> int | None:
    return value if value >= 0 else None
