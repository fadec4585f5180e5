"""Both runs from their first difference on, a block at a time, as one list of matched events.

A block is a few thousand events of both runs, cut where both have reached the same time; beyond
the cut some more are loaded, so that an event near the cut finds its counterpart behind it.
"""

from __future__ import annotations

import itertools
from bisect import bisect_left
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from rsltrace.diff.alignment.align import EarlierPairs, EventPairs, align
from rsltrace.diff.alignment.rows import (
    CONSTRUCT,
    SHUTDOWN,
    ComparedTrace,
    EventColumns,
    load_rows,
    longest_increasing,
)
from rsltrace.fast_dataclass import dataclass

NOTHING = -1

_COMPARED = "stamp entity kind flags input_hash output_hash state_hash outputs".split()
_COMPARED_AT_ONCE = 4096
_EQUAL_MIN = 512

_MARGIN_MIN = 1024
"""Events looked at beyond the cut: an event that came later by more than that is called missing."""


@dataclass(slots=True)
class EventPair:
    """An event of one run with its counterpart in the other; indexes, or -1 where there is none.

    ``same`` if both did the same at the same time; ``inverted`` if another event at that time
    comes before it in one run and after it in the other. ``beyond`` if the other run had ended.
    """

    a: int
    b: int
    same: bool
    inverted: bool = False
    beyond: bool = False

    @property
    def plain(self) -> bool:
        """Whether there is nothing to say about it."""
        return self.same and not self.inverted


@dataclass
class AlignedBlock:
    """A part of both runs. ``items`` are in the order of events; ``end_a`` and ``end_b`` are the
    indexes up to which the runs are aligned after it. ``rows`` reach a little further."""

    rows_a: EventColumns
    rows_b: EventColumns
    items: list[EventPair]
    end_a: int
    end_b: int

    @property
    def at_end(self) -> bool:
        """Whether both runs are over."""
        return (
            self.rows_a.at_end
            and self.rows_b.at_end
            and self.end_a == self.rows_a.end
            and self.end_b == self.rows_b.end
        )

    def stamp(self, item: EventPair) -> int:
        """Return when an item happened: in a, or in b if only that has it."""
        if item.a >= 0:
            return self.rows_a.stamp[item.a - self.rows_a.first]
        return self.rows_b.stamp[item.b - self.rows_b.first]


@dataclass
class EqualBlock:
    """Events that are the same in both runs, in a row: nothing to match. ``counts`` has their
    numbers by entity number, shape (entities,); they end at ``end_a`` and ``end_b``."""

    first_a: int
    first_b: int
    counts: npt.NDArray[np.int64]
    end_a: int
    end_b: int


@dataclass
class AlignedBlocks:
    """Iterates over the runs from index ``start`` on, which is the same event in both.

    ``events`` is how many of each run make a block. With ``skip_equal``, long runs of equal
    events between blocks come as an EqualBlock, which takes a fraction of the time.
    """

    run_a: ComparedTrace
    run_b: ComparedTrace
    start: int
    events: int
    skip_equal: bool = False

    def __iter__(self) -> Iterator[AlignedBlock | EqualBlock]:
        first_a = first_b = self.start
        taken_a: set[int] = set()
        taken_b: set[int] = set()
        past = EarlierPairs(self.start)
        while True:
            block, pairs = self._next(first_a, first_b, past, taken_a, taken_b)
            yield block
            if block.at_end:
                return
            rows_a, rows_b = block.rows_a, block.rows_b
            recent = {
                rows_b.first + place: rows_a.first + partner
                for place, partner in enumerate(pairs.b)
                if partner >= 0
            }
            # Causes are mostly recent; what is older than two blocks is forgotten.
            kept = {b: a for b, a in past.recent.items() if b >= rows_b.first - self.events}
            past = EarlierPairs(self.start, {**kept, **recent}, past.equal_run)
            first_a, first_b = block.end_a, block.end_b
            taken_a = {a for a in taken_a.union(i.a for i in block.items) if a >= first_a}
            taken_b = {b for b in taken_b.union(i.b for i in block.items) if b >= first_b}
            if self.skip_equal and not taken_a and not taken_b:
                run = equal_block(self.run_a, self.run_b, first_a, first_b)
                if run is not None:
                    yield run
                    past = EarlierPairs(
                        self.start, past.recent, (first_a, first_b, run.end_a - first_a)
                    )
                    first_a, first_b = run.end_a, run.end_b

    def _next(
        self, first_a: int, first_b: int, past: EarlierPairs, taken_a: set[int], taken_b: set[int]
    ) -> tuple[AlignedBlock, EventPairs]:
        events, margin = self.events, max(_MARGIN_MIN, self.events // 4)
        while True:
            rows_a = load_rows(self.run_a, first_a, first_a + events + margin)
            rows_b = load_rows(self.run_b, first_b, first_b + events + margin)
            end_a, end_b = _cuts(rows_a, rows_b, events)
            if end_a > 0 or end_b > 0 or not (len(rows_a) or len(rows_b)):
                break
            events *= 4  # all at one time: read more, or there would be no progress
        pairs = align(rows_a, rows_b, past, taken_a, taken_b)
        items = _items(rows_a, rows_b, pairs, end_a, end_b, taken_a, taken_b)
        block = AlignedBlock(rows_a, rows_b, items, first_a + end_a, first_b + end_b)
        _mark_inversions(block)
        if rows_a.at_end or rows_b.at_end:
            _mark_beyond(block)
        return block, pairs


def equal_block(
    run_a: ComparedTrace, run_b: ComparedTrace, first_a: int, first_b: int
) -> EqualBlock | None:
    """Return the events from here on that are equal in a row, if there are many of them."""
    if not run_a.matching.same_ids:
        return None  # the trace's own output hashes say nothing then
    counts = np.zeros(len(run_a.matching.keys), dtype=np.int64)
    done = 0
    while True:
        last_a, last_b = first_a + done + _COMPARED_AT_ONCE, first_b + done + _COMPARED_AT_ONCE
        parts_a = list(run_a.trace.events(first_a + done, last_a))
        parts_b = list(run_b.trace.events(first_b + done, last_b))
        if not parts_a or not parts_b:
            break
        a, b = np.concatenate(parts_a), np.concatenate(parts_b)
        size = min(len(a), len(b))
        equal = a["kind"][:size] != CONSTRUCT
        for name in _COMPARED:
            equal &= a[name][:size] == b[name][:size]
        agreeing = size if equal.all() else int(np.argmin(equal))
        numbers = run_a.matching.numbers(run_a.trace, a["entity"][:agreeing], of_b=False)
        counts += np.bincount(numbers, minlength=len(counts))
        done += agreeing
        if agreeing < _COMPARED_AT_ONCE:
            break
    if done < _EQUAL_MIN:
        return None
    return EqualBlock(first_a, first_b, counts, first_a + done, first_b + done)


def _cuts(a: EventColumns, b: EventColumns, events: int) -> tuple[int, int]:
    """Return how many events of each belong to the block: all before some common time."""
    limits = []
    for rows in (a, b):
        times = rows.times
        if not (rows.at_end and len(rows) <= events):
            limits.append(times[min(events, len(rows) - 1)])
        if not rows.at_end:
            limits.append(times[-1])
    if not limits:
        return len(a), len(b)
    return bisect_left(a.times, min(limits)), bisect_left(b.times, min(limits))


def _items(
    a: EventColumns,
    b: EventColumns,
    pairs: EventPairs,
    end_a: int,
    end_b: int,
    taken_a: set[int],
    taken_b: set[int],
) -> list[EventPair]:
    times_a, times_b = a.times, b.times
    spine = _spine(a, b, pairs)
    keyed: list[tuple[int, float, int, EventPair]] = []
    last = -0.5  # where an event stands that is only in b, or earlier in b: behind the spine so far
    for place in range(end_b):
        partner, time = pairs.b[place], times_b[place]
        position = last
        if partner >= 0:
            item = _pair(a, b, partner, place)
            if place in spine:
                position, last = partner, partner + 0.5
            elif times_a[partner] < time:
                position, time = partner, times_a[partner]
            elif times_a[partner] == time:
                position = min(partner, last)
        elif b.first + place in taken_b:
            continue
        else:
            item = EventPair(NOTHING, b.first + place, False)
        keyed.append((time, position, place, item))
    for place in range(end_a):
        partner = pairs.a[place]
        if partner >= end_b:
            time = min(times_a[place], times_b[partner])
            keyed.append((time, place, partner, _pair(a, b, place, partner)))
        elif partner < 0 and a.first + place not in taken_a:
            keyed.append(
                (times_a[place], place, NOTHING, EventPair(a.first + place, NOTHING, False))
            )
    keyed.sort(key=lambda entry: entry[:3])
    return [item for _, _, _, item in keyed]


def _spine(a: EventColumns, b: EventColumns, pairs: EventPairs) -> frozenset[int]:
    """Return the places in b of as many pairs as can be that are in the same order in both runs,
    have the same input and happened at the same time: what the rest is ordered by."""
    times_a, times_b = a.times, b.times
    return longest_increasing(
        [
            partner
            if partner >= 0
            and times_a[partner] == times_b[place]
            and a.input[partner] == b.input[place]
            else NOTHING
            for place, partner in enumerate(pairs.b)
        ]
    )


def _pair(a: EventColumns, b: EventColumns, place_a: int, place_b: int) -> EventPair:
    same = (
        a.stamp[place_a] == b.stamp[place_b]
        and a.input[place_a] == b.input[place_b]
        and a.content[place_a] == b.content[place_b]
        and a.flags[place_a] == b.flags[place_b]
        and a.state[place_a] == b.state[place_b]
    )
    return EventPair(a.first + place_a, b.first + place_b, same)


def _mark_inversions(block: AlignedBlock) -> None:
    """Mark events that changed places with others at the same simulated time."""
    a, b = block.rows_a, block.rows_b
    moments: dict[int, list[EventPair]] = {}
    for item in block.items:
        if item.a >= 0 and item.b >= 0:
            i, j = item.a - a.first, item.b - b.first
            # A pair with different inputs matches by position only: its order says nothing.
            if a.stamp[i] == b.stamp[j] and a.input[i] == b.input[j]:
                moments.setdefault(a.stamp[i], []).append(item)
    for items in moments.values():
        mark_inverted(items)


def mark_inverted(items: list[EventPair]) -> None:
    """Set ``inverted`` of pairs at one time that are in a different order in b."""
    items.sort(key=lambda item: item.a)
    order = [item.b for item in items]
    if all(early < late for early, late in itertools.pairwise(order)):
        return
    latest = -1
    for item in items:
        item.inverted = latest > item.b
        latest = max(latest, item.b)
    earliest = 1 << 62
    for item in reversed(items):
        item.inverted = item.inverted or earliest < item.b
        earliest = min(earliest, item.b)


def _mark_beyond(block: AlignedBlock) -> None:
    """Mark what one run did after the other had ended. Shutting nodes down is not doing, and a
    run that continues to a later time without an event has not ended."""
    for rows, other, end, of_b in (
        (block.rows_a, block.rows_b, block.end_b, False),
        (block.rows_b, block.rows_a, block.end_a, True),
    ):
        if not other.at_end or end < other.end:
            continue
        for item in reversed(block.items):
            theirs, mine = (item.a, item.b) if of_b else (item.b, item.a)
            if theirs >= 0:
                over = other.run.trace.ended_after
                unwinding = over is not None and theirs >= over
                if other.kind[theirs - other.first] != SHUTDOWN and not unwinding:
                    break
            elif rows.kind[mine - rows.first] != SHUTDOWN:
                item.beyond = rows.stamp[mine - rows.first] >= other.run.trace.end_ns
