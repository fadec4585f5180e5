"""Which event of one run is which of the other, once they have diverged.

Events are matched within one kind of one entity only (see ``match``): the same input at the same
time from the same cause is surest, "the one that stands in its place" is weakest. What is left over
is in one run only.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from rsltrace.diff.alignment.match import NO_CAUSE, UNKNOWN, EventSequence, match
from rsltrace.diff.alignment.rows import Rows
from rsltrace.trace.model.event import NO_EVENT


@dataclass
class Pairs:
    """Who belongs to whom, by place in the two ``Rows`` (-1: nobody)."""

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


def align(a: Rows, b: Rows, past: EarlierPairs, taken_a: set[int], taken_b: set[int]) -> Pairs:
    """Match the events of two blocks. Those whose indexes are in ``taken_a`` and ``taken_b``
    have partners in an earlier block and are left alone."""
    groups = _groups(a, b, taken_a, taken_b)
    pairs = Pairs([], [])
    # The partner of an event's cause is a strong sign, and known only when causes are matched: so
    # what is certain without it comes first, and then everything is matched anew with it.
    for surest_only in (True, False, False):
        causes_a, causes_b = _causes(a, b, pairs, past)
        pairs = Pairs([-1] * len(a), [-1] * len(b))
        for places_a, places_b in groups:
            sequence_a, sequence_b = (
                _sequence(a, causes_a, places_a),
                _sequence(b, causes_b, places_b),
            )
            for i, j in match(sequence_a, sequence_b, surest_only=surest_only):
                pairs.a[places_a[i]] = places_b[j]
                pairs.b[places_b[j]] = places_a[i]
    return pairs


def _sequence(rows: Rows, causes: list[int], places: list[int]) -> EventSequence:
    stamp, input_, nth = rows.stamp, rows.input, rows.cause_output
    return EventSequence(
        stamp=[stamp[place] for place in places],
        input=[input_[place] for place in places],
        cause=[causes[place] for place in places],
        nth=[nth[place] for place in places],
    )


def _groups(
    a: Rows, b: Rows, taken_a: set[int], taken_b: set[int]
) -> list[tuple[list[int], list[int]]]:
    groups: dict[tuple[int, int], tuple[list[int], list[int]]] = {}
    for rows, taken, side in ((a, taken_a, 0), (b, taken_b, 1)):
        for place, key in enumerate(zip(rows.number, rows.kind, strict=True)):
            if rows.first + place not in taken:
                groups.setdefault(key, ([], []))[side].append(place)
    return [group for group in groups.values() if group[0] and group[1]]


def _causes(a: Rows, b: Rows, pairs: Pairs, past: EarlierPairs) -> tuple[list[int], list[int]]:
    """Return the causes of all events as indexes in a, so that equal causes are equal numbers.

    NO_CAUSE for events without one, UNKNOWN where the cause has (as yet) no counterpart.
    """
    causes_a, causes_b = [], []
    first, end = a.first, a.first + len(pairs.a)
    for cause in a.cause:
        if cause == NO_EVENT:
            causes_a.append(NO_CAUSE)
        elif first <= cause < end:
            causes_a.append(cause if pairs.a[cause - first] >= 0 else UNKNOWN)
        else:
            causes_a.append(cause if past.has_partner(cause) else UNKNOWN)
    first, end = b.first, b.first + len(pairs.b)
    for cause in b.cause:
        if cause == NO_EVENT:
            causes_b.append(NO_CAUSE)
        elif first <= cause < end and (place := pairs.b[cause - first]) >= 0:
            causes_b.append(a.first + place)
        else:
            causes_b.append(past.in_a(cause) if not first <= cause < end else UNKNOWN)
    return causes_a, causes_b
