"""Which event of one run is which of the other, once the runs have parted.

Events are matched within an entity only, and there from the surest sign to the weakest: the same
input at the same time from the same cause, …, down to "the one that stands in its place". Signs
first hold in order (as in any comparison of two sequences) and then across it, because a message
that came later than another is the same message still. What is left over is in one run only.
"""

from __future__ import annotations

import itertools
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median_low

from rsltrace.diff.rows import Rows
from rsltrace.model.event import NO_EVENT

NO_CAUSE = -1
UNKNOWN = -2

Key = tuple[int, ...]
Partners = Mapping[int, int]
"""By index of an event in b: the index of its counterpart in a."""

_TABLE_MAX = 10_000
"""Cells of the table with which leftovers are paired at best; larger ones are paired in passing."""


@dataclass
class Pairs:
    """Who belongs to whom, by place in the two ``Rows`` (-1: nobody)."""

    a: list[int]
    b: list[int]

    def pair(self, place_a: int, place_b: int) -> None:
        """Make two events counterparts."""
        self.a[place_a] = place_b
        self.b[place_b] = place_a


def align(
    a: Rows, b: Rows, same_before: int, known: Partners, taken_a: set[int], taken_b: set[int]
) -> Pairs:
    """Match the events of two stretches.

    Events before index ``same_before`` are the same in both runs; ``known`` has partners of later
    ones that were found before. Events whose indexes are in ``taken_a`` and ``taken_b`` have
    partners in an earlier stretch and are left alone.
    """
    groups = _groups(a, b, taken_a, taken_b)
    pairs = Pairs([], [])
    # The partner of an event's cause is a strong sign, and known only when causes are matched: so
    # what is certain without it comes first, and then everything is matched anew with it.
    for surest_only in (True, False, False):
        causes_a, causes_b = _causes(a, b, pairs, same_before, known)
        pairs = Pairs([-1] * len(a), [-1] * len(b))
        for places_a, places_b in groups:
            _Group(a, b, causes_a, causes_b, places_a, places_b).match(pairs, surest_only)
    return pairs


def _groups(
    a: Rows, b: Rows, taken_a: set[int], taken_b: set[int]
) -> list[tuple[list[int], list[int]]]:
    groups: dict[tuple[int, int], tuple[list[int], list[int]]] = {}
    for rows, taken, side in ((a, taken_a, 0), (b, taken_b, 1)):
        for place, key in enumerate(zip(rows.number, rows.kind, strict=True)):
            if rows.first + place not in taken:
                groups.setdefault(key, ([], []))[side].append(place)
    return [group for group in groups.values() if group[0] and group[1]]


def _causes(
    a: Rows, b: Rows, pairs: Pairs, same_before: int, known: Partners
) -> tuple[list[int], list[int]]:
    """Return the causes of all events as indexes in a, so that equal causes are equal numbers.

    NO_CAUSE for events without one, UNKNOWN where the cause has (as yet) no counterpart.
    """
    known_a = set(known.values())
    causes_a, causes_b = [], []
    for cause in a.cause:
        if cause == NO_EVENT:
            causes_a.append(NO_CAUSE)
        elif a.first <= cause < a.first + len(pairs.a):
            causes_a.append(cause if pairs.a[cause - a.first] >= 0 else UNKNOWN)
        else:
            causes_a.append(cause if cause < same_before or cause in known_a else UNKNOWN)
    for cause in b.cause:
        if cause == NO_EVENT:
            causes_b.append(NO_CAUSE)
        elif cause < same_before:
            causes_b.append(cause)
        elif b.first <= cause < b.first + len(pairs.b):
            place = pairs.b[cause - b.first]
            causes_b.append(a.first + place if place >= 0 else UNKNOWN)
        else:
            causes_b.append(known.get(cause, UNKNOWN))
    return causes_a, causes_b


@dataclass
class _Group:
    """The events of one kind of one entity: ``places_a`` and ``places_b`` in ``Rows``.

    Below, positions count within the group. ``spine`` holds, in order, the positions of pairs that
    do not cross each other.
    """

    a: Rows
    b: Rows
    causes_a: list[int]
    causes_b: list[int]
    places_a: list[int]
    places_b: list[int]
    free_a: list[int] = field(default_factory=list)
    free_b: list[int] = field(default_factory=list)
    spine: list[tuple[int, int]] = field(default_factory=list)

    def match(self, pairs: Pairs, surest_only: bool) -> None:
        """Find the pairs and enter them in ``pairs``."""
        self._pairs = pairs
        self.free_a = list(range(len(self.places_a)))
        self.free_b = list(range(len(self.places_b)))
        for signs in _SIGNS[:_SUREST] if surest_only else _SIGNS:
            if not self.free_a or not self.free_b:
                return
            self._tier(*signs)
        if not surest_only:
            self._neighbours()

    def _tier(self, names: str, in_order: bool, unique: bool) -> None:
        keys_a, keys_b = self._keys(names, unique)
        waiting: dict[Key, list[int]] = {}
        for position in reversed(self.free_b):
            if (key := keys_b(position)) is not None:
                waiting.setdefault(key, []).append(position)
        if not waiting:
            return
        found: list[tuple[int, int]] = []
        bound, spine_at = -1, 0
        for position in self.free_a:
            key = keys_a(position)
            candidates = waiting.get(key) if key is not None else None
            if not candidates:
                continue
            if in_order:
                while spine_at < len(self.spine) and self.spine[spine_at][0] < position:
                    bound = max(bound, self.spine[spine_at][1])
                    spine_at += 1
                limit = self.spine[spine_at][1] if spine_at < len(self.spine) else 1 << 62
                while candidates and candidates[-1] <= bound:
                    candidates.pop()
                if not candidates or candidates[-1] >= limit:
                    continue
                bound = candidates[-1]
            found.append((position, candidates.pop()))
        self._enter(found, in_order)

    def _keys(
        self, names: str, unique: bool
    ) -> tuple[Callable[[int], Key | None], Callable[[int], Key | None]]:
        """Return functions from a position to its key: None where the sign says nothing."""
        sides = []
        for rows, causes, places in (
            (self.a, self.causes_a, self.places_a),
            (self.b, self.causes_b, self.places_b),
        ):
            columns = [
                {"s": rows.stamp, "i": rows.input, "c": causes, "?": causes}[name] for name in names
            ]
            outputs = rows.cause_output if "c" in names else None
            sides.append((columns, outputs, places))
        counts: list[Counter[int]] = []
        if unique:
            for rows, places in ((self.a, self.places_a), (self.b, self.places_b)):
                counts.append(Counter(rows.input[place] for place in places))
        input_at, cause_at = names.find("i"), names.find("c")

        def keys(
            columns: Sequence[Sequence[int]], outputs: Sequence[int] | None, places: Sequence[int]
        ) -> Callable[[int], Key | None]:
            def key(position: int) -> Key | None:
                place = places[position]
                values = [column[place] for column in columns]
                if cause_at >= 0 and values[cause_at] < 0:
                    return None
                if input_at >= 0 and values[input_at] == 0 and "s" not in names:
                    return None
                if unique and any(count[values[input_at]] != 1 for count in counts):
                    return None
                if outputs is not None:
                    values.append(outputs[place])
                return tuple(values)

            return key

        return keys(*sides[0]), keys(*sides[1])

    def _enter(self, found: Sequence[tuple[int, int]], in_order: bool) -> None:
        if not found:
            return
        for position_a, position_b in found:
            self._pairs.pair(self.places_a[position_a], self.places_b[position_b])
        gone_a, gone_b = {p for p, _ in found}, {p for _, p in found}
        self.free_a = [p for p in self.free_a if p not in gone_a]
        self.free_b = [p for p in self.free_b if p not in gone_b]
        if in_order:
            self.spine = sorted([*self.spine, *found])

    def _neighbours(self) -> None:
        """Pair what has nothing in common but its place: between the same others, about then."""
        if not self.free_a or not self.free_b:
            return
        limit = self._usual_gap()
        ends = [*self.spine, (len(self.places_a), len(self.places_b))]
        begin_a = begin_b = -1
        for end_a, end_b in ends:
            some_a = _between(self.free_a, begin_a, end_a)
            some_b = _between(self.free_b, begin_b, end_b)
            if some_a and some_b:
                places_a = [self.places_a[p] for p in some_a]
                places_b = [self.places_b[p] for p in some_b]
                whens_a = [(self.a.stamp[p], self.causes_a[p]) for p in places_a]
                whens_b = [(self.b.stamp[p], self.causes_b[p]) for p in places_b]
                for i, j in _nearest(whens_a, whens_b, limit):
                    self._pairs.pair(places_a[i], places_b[j])
            begin_a, begin_b = end_a, end_b

    def _usual_gap(self) -> int:
        """Return the usual time between events of this entity; -1 if it has too few to tell."""
        medians = []
        for rows, places in ((self.a, self.places_a), (self.b, self.places_b)):
            stamps = [rows.stamp[place] for place in places]
            gaps = [late - early for early, late in itertools.pairwise(stamps)]
            medians += [median_low(gaps)] if gaps else []
        return max(medians, default=-1)


_SIGNS = (
    ("sic", True, False),
    ("sic", False, False),
    ("si", True, False),
    ("si", False, False),
    ("sc", True, False),
    ("ic", True, False),
    ("ic", False, False),
    ("i?", True, True),
    ("i?", False, True),
    ("s?", True, False),
)
"""(what has to be equal: stamp, input, cause, cause or the lack of one; only in order; only inputs
that come once)."""

_SUREST = 3


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
