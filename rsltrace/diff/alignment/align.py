"""Which event of one run is which of the other, once they have diverged.

Events are matched within one kind of one entity only (see ``match``): the same input at the same
time from the same cause is surest, the same position is weakest. What is left over
is in one run only.
"""

from __future__ import annotations

import itertools
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import field

from rsltrace.diff.alignment.rows import EventColumns
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.event import NO_EVENT

# Matching two sequences of events of one entity: from the surest sign to the weakest.
#
# Signs first hold in order (as in any comparison of two sequences) and then across it, because a
# message that came later than another is the same message still.

NO_CAUSE = -1
"""The cause of an event that nothing caused."""

UNKNOWN = -2
"""The cause of an event whose cause has no counterpart in the other run, or none found yet."""

Key = tuple[int, ...]
Pair = tuple[int, int]

_TABLE_MAX = 10_000
"""Cells of the table with which leftovers are paired at best; larger ones are paired in passing."""

_SIGNS = (
    ("sic", True),
    ("sic", False),
    ("si", True),
    ("si", False),
    ("sc", True),
    ("ic", True),
    ("ic", False),
    ("i?", True),
    ("i?", False),
    ("s?", True),
)
"""(what has to be equal: stamp, input, cause, cause or the lack of one; only in order)."""

_SUREST = 3


@dataclass(frozen=True, slots=True)
class EventSequence:
    """The events of one kind of one entity in one run, as columns.

    ``cause`` is an index that means the same event in both runs, or NO_CAUSE, or UNKNOWN; ``nth``
    says which of its outputs.
    """

    stamp: Sequence[int]
    input: Sequence[int]
    cause: Sequence[int]
    nth: Sequence[int]

    def __len__(self) -> int:
        return len(self.stamp)

    @property
    def columns(self) -> tuple[Sequence[int], ...]:
        return self.stamp, self.input, self.cause, self.nth


def match(a: EventSequence, b: EventSequence, *, surest_only: bool) -> list[Pair]:
    """Return pairs of positions: which event of ``a`` is which of ``b``, whichever comes first."""
    if b.columns < a.columns:  # what is taken in passing depends on the order of the two
        return [(i, j) for j, i in match(b, a, surest_only=surest_only)]
    begin, end = _same_ends(a, b)
    pairs = [(position, position) for position in range(begin)]
    shift = len(b) - len(a)
    pairs += [(position, position + shift) for position in range(len(a) - end, len(a))]
    if begin + end < len(a) and begin + end < len(b):
        free_a = list(range(begin, len(a) - end))
        free_b = list(range(begin, len(b) - end))
        pairs += _Matching(a, b, free_a, free_b).run(surest_only)
    return pairs


def _same_ends(a: EventSequence, b: EventSequence) -> tuple[int, int]:
    """Return how many events at the beginning and at the end are certainly pairs."""
    begin = _certain(a.columns, b.columns)
    end = _certain(*([column[begin:][::-1] for column in one.columns] for one in (a, b)))
    return begin, end


def _certain(a: Iterable[Sequence[int]], b: Iterable[Sequence[int]]) -> int:
    """Return how many events from the beginning are certainly pairs; the arguments are columns."""
    count = 0
    for mine, theirs in zip(zip(*a, strict=True), zip(*b, strict=True), strict=False):
        if mine != theirs:
            stamp, received, cause, nth = mine
            other_stamp, other_received, other_cause, other_nth = theirs
            if stamp != other_stamp or cause != other_cause:
                break
            if received != other_received and (cause < 0 or nth != other_nth):
                break
        count += 1
    return count


class _Matching:
    """The events between the ends. ``spine`` holds, in order, pairs that do not cross."""

    def __init__(
        self, a: EventSequence, b: EventSequence, free_a: list[int], free_b: list[int]
    ) -> None:
        self._a = a
        self._b = b
        self._first = (free_a[0] - 1, free_b[0] - 1)
        self._last = (free_a[-1] + 1, free_b[-1] + 1)
        self._free_a = free_a
        self._free_b = free_b
        self._pairs: list[Pair] = []
        self._spine: list[Pair] = []

    def run(self, surest_only: bool) -> list[Pair]:
        """Return the pairs."""
        for names, in_order in _SIGNS[:_SUREST] if surest_only else _SIGNS:
            if not self._free_a or not self._free_b:
                break
            self._tier(names, in_order)
        else:
            if not surest_only and self._free_a and self._free_b:
                self._neighbours()
        return self._pairs

    def _tier(self, names: str, in_order: bool) -> None:
        waiting: dict[Key, list[int]] = {}
        for position, key in zip(
            reversed(self._free_b), reversed(self._keys(names, self._b, self._free_b)), strict=True
        ):
            if key is not None:
                waiting.setdefault(key, []).append(position)
        if not waiting:
            return
        found: list[Pair] = []
        spine, spine_at, bound = self._spine, 0, -1
        for position, key in zip(
            self._free_a, self._keys(names, self._a, self._free_a), strict=True
        ):
            candidates = waiting.get(key) if key is not None else None
            if not candidates:
                continue
            if in_order:
                while spine_at < len(spine) and spine[spine_at][0] < position:
                    bound = max(bound, spine[spine_at][1])
                    spine_at += 1
                limit = spine[spine_at][1] if spine_at < len(spine) else 1 << 62
                while candidates and candidates[-1] <= bound:
                    candidates.pop()
                if not candidates or candidates[-1] >= limit:
                    continue
                bound = candidates[-1]
            found.append((position, candidates.pop()))
        self._enter(found, in_order)

    def _keys(self, names: str, sequence: EventSequence, free: list[int]) -> list[Key | None]:
        """Return the key of each free position: None where the sign says nothing."""
        s, i, c, n = sequence.stamp, sequence.input, sequence.cause, sequence.nth
        if names == "sic":
            return [(s[p], i[p], c[p], n[p]) if c[p] >= 0 else None for p in free]
        if names == "si":
            return [(s[p], i[p]) for p in free]
        if names == "sc":
            return [(s[p], c[p], n[p]) if c[p] >= 0 else None for p in free]
        if names == "ic":
            return [(i[p], c[p], n[p]) if c[p] >= 0 and i[p] else None for p in free]
        if names == "s?":
            return [(s[p], c[p]) for p in free]
        assert names == "i?"
        # An input that comes again and again says nothing about which event it is.
        once = self._inputs_that_come_once
        return [(i[p], c[p]) if i[p] in once else None for p in free]

    @property
    def _inputs_that_come_once(self) -> set[int]:
        counts_a, counts_b = Counter(self._a.input), Counter(self._b.input)
        return {i for i, count in counts_a.items() if count == 1 == counts_b[i] and i}

    def _enter(self, found: list[Pair], in_order: bool) -> None:
        if not found:
            return
        self._pairs += found
        gone_a, gone_b = {p for p, _ in found}, {p for _, p in found}
        self._free_a = [p for p in self._free_a if p not in gone_a]
        self._free_b = [p for p in self._free_b if p not in gone_b]
        if in_order:
            self._spine = sorted([*self._spine, *found])

    def _neighbours(self) -> None:
        """Pair what has nothing in common but its place: between the same others, about then."""
        a, b = self._a, self._b
        limit = max(_usual_gap(a.stamp), _usual_gap(b.stamp))
        begin_a, begin_b = self._first
        for end_a, end_b in [*self._spine, self._last]:
            some_a = _between(self._free_a, begin_a, end_a)
            some_b = _between(self._free_b, begin_b, end_b)
            if some_a and some_b:
                whens_a = [(a.stamp[p], a.cause[p]) for p in some_a]
                whens_b = [(b.stamp[p], b.cause[p]) for p in some_b]
                nearest = _nearest(whens_a, whens_b, limit)
                self._pairs += [(some_a[i], some_b[j]) for i, j in nearest]
            begin_a, begin_b = end_a, end_b


def _usual_gap(stamps: Sequence[int]) -> int:
    """Return the usual time between events; -1 if there are too few to tell."""
    gaps = sorted(late - early for early, late in itertools.pairwise(stamps))
    return gaps[(len(gaps) - 1) // 2] if gaps else -1


def _between(positions: list[int], begin: int, end: int) -> list[int]:
    return positions[bisect_right(positions, begin) : bisect_left(positions, end)]


When = tuple[int, int]
"""(stamp, cause or NO_CAUSE or UNKNOWN) of an event."""


def _nearest(a: list[When], b: list[When], limit: int) -> list[tuple[int, int]]:
    """Pair events in order, as many as can be that are at most ``limit`` apart (-1: any) and not
    known to come from different causes, and of these ways the one with the least distance."""
    if len(a) * len(b) > _TABLE_MAX:
        return _nearest_in_passing(a, b, limit)
    # best[j]: (pairs, -distance, the pairs) of the first i events of a and the first j of b.
    best: list[tuple[int, int, tuple[object, ...]]] = [(0, 0, ())] * (len(b) + 1)
    for i, when_a in enumerate(a):
        previous, best = best, [best[0]]
        for j, when_b in enumerate(b):
            choice = max(previous[j + 1], best[j], key=lambda option: option[:2])
            if _can_be(when_a, when_b, limit):
                pairs, closeness, chosen = previous[j]
                closeness -= abs(when_a[0] - when_b[0])
                candidate = (pairs + 1, closeness, (chosen, i, j))
                choice = max(choice, candidate, key=lambda option: option[:2])
            best.append(choice)
    result = []
    chosen = best[-1][2]
    while chosen:
        chosen, i, j = chosen  # type: ignore[assignment]
        result.append((i, j))
    return result[::-1]


def _nearest_in_passing(a: list[When], b: list[When], limit: int) -> list[tuple[int, int]]:
    result, i, j = [], 0, 0
    while i < len(a) and j < len(b):
        if _can_be(a[i], b[j], limit):
            result.append((i, j))
            i, j = i + 1, j + 1
        elif a[i] < b[j]:
            i += 1
        else:
            j += 1
    return result


def _can_be(a: When, b: When, limit: int) -> bool:
    return a[1] == b[1] and (limit < 0 or abs(a[0] - b[0]) <= limit)


@dataclass
class EventPairs:
    """The partner of each event, by place in the two ``EventColumns`` (-1: none)."""

    a: list[int]
    b: list[int]


@dataclass
class EarlierPairs:
    """What is known of earlier events.

    Those before index ``same_before`` are the same in both runs. ``recent`` has partners of others:
    by index in b the index in a. ``equal_run`` is the last long run of equal events: first index in
    a, first in b, how many.
    """

    same_before: int
    recent: dict[int, int] = field(default_factory=dict)
    equal_run: tuple[int, int, int] = (0, 0, 0)

    def __post_init__(self) -> None:
        self._recent_a = frozenset(self.recent.values())

    def in_a(self, index_b: int) -> int:
        """Return the index in a of an event of b, or UNKNOWN."""
        if index_b < self.same_before:
            return index_b
        first_a, first_b, count = self.equal_run
        if first_b <= index_b < first_b + count:
            return index_b - first_b + first_a
        return self.recent.get(index_b, UNKNOWN)

    def has_partner(self, index_a: int) -> bool:
        """Whether an event of a is known to have a counterpart."""
        first_a, _, count = self.equal_run
        return (
            index_a < self.same_before
            or first_a <= index_a < first_a + count
            or index_a in self._recent_a
        )


def align(
    a: EventColumns, b: EventColumns, past: EarlierPairs, taken_a: set[int], taken_b: set[int]
) -> EventPairs:
    """Match the events of two blocks. Those whose indexes are in ``taken_a`` and ``taken_b``
    have partners in an earlier block and are left alone."""
    groups = _groups(a, b, taken_a, taken_b)
    causes_a, causes_b = _earlier_causes(a, b, past)
    caused_a, caused_b = _caused_in(a), _caused_in(b)
    pairs: EventPairs | None = None
    before: tuple[bool, list[int], list[int]] | None = None
    # The partner of an event's cause is a strong sign, and known only when causes are matched: so
    # what is certain without it comes first, and then everything is matched again with it.
    for surest_only in (True, False, False):
        if pairs is not None:
            causes_a, causes_b = [*causes_a], [*causes_b]
            for place, at in caused_a:
                causes_a[place] = a.first + at if pairs.a[at] >= 0 else UNKNOWN
            for place, at in caused_b:
                partner = pairs.b[at]
                causes_b[place] = a.first + partner if partner >= 0 else UNKNOWN
        known = surest_only, causes_a, causes_b
        if known == before:
            break  # the same pairs would come out again
        before = known
        pairs = EventPairs([-1] * len(a), [-1] * len(b))
        for places_a, places_b in groups:
            sequence_a, sequence_b = (
                _sequence(a, causes_a, places_a),
                _sequence(b, causes_b, places_b),
            )
            for i, j in match(sequence_a, sequence_b, surest_only=surest_only):
                pairs.a[places_a[i]] = places_b[j]
                pairs.b[places_b[j]] = places_a[i]
    assert pairs is not None
    return pairs


def _sequence(rows: EventColumns, causes: list[int], places: list[int]) -> EventSequence:
    columns = (rows.stamp, rows.input, causes, rows.cause_output)
    return EventSequence(*([*map(column.__getitem__, places)] for column in columns))


def _groups(
    a: EventColumns, b: EventColumns, taken_a: set[int], taken_b: set[int]
) -> list[tuple[list[int], list[int]]]:
    groups: defaultdict[tuple[int, int], tuple[list[int], list[int]]]
    groups = defaultdict(lambda: ([], []))
    for rows, taken, side in ((a, taken_a, 0), (b, taken_b, 1)):
        for place, key in enumerate(zip(rows.number, rows.kind, strict=True)):
            if not taken or rows.first + place not in taken:
                groups[key][side].append(place)
    return [group for group in groups.values() if group[0] and group[1]]


def _earlier_causes(
    a: EventColumns, b: EventColumns, past: EarlierPairs
) -> tuple[list[int], list[int]]:
    """Return the causes of all events as indexes in a, so that equal causes are equal numbers.

    NO_CAUSE for events without one, UNKNOWN where no earlier block has a counterpart of the cause.
    """
    causes_a = [
        NO_CAUSE if cause == NO_EVENT else cause if past.has_partner(cause) else UNKNOWN
        for cause in a.cause
    ]
    causes_b = [NO_CAUSE if cause == NO_EVENT else past.in_a(cause) for cause in b.cause]
    return causes_a, causes_b


def _caused_in(rows: EventColumns) -> list[Pair]:
    """Return the places of events whose cause is in the block, and of that."""
    first, end = rows.first, rows.end
    return [
        (place, cause - first) for place, cause in enumerate(rows.cause) if first <= cause < end
    ]
