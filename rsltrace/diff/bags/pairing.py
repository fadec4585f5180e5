"""Which messages of a gap belong together: decided by content, where their keys differ."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from rsltrace.diff.bags.sequences import Gap, Keys, is_turned
from rsltrace.diff.values.fields import field_differences
from rsltrace.diff.values.globs import FieldRules
from rsltrace.errors import TraceError

LOOKAHEAD = 16
"""How many surplus messages in a row are looked past for the counterpart of one."""

Get = Callable[[int], object | None]
"""Gives the decoded message of an index, None if it is not available; may raise TraceError."""


class MessagePair(NamedTuple):
    """Messages that belong together; -1 where there is none."""

    a: int
    b: int


@dataclass(frozen=True, slots=True)
class Pairing:
    """Pairs the messages of two recordings of one topic, under ``rules``.

    ``by_stamp``: gaps are of one log time, and messages belong together in their order.
    ``tolerant``: with tolerances, where keys differ that belong together, and all are at hand.
    """

    get_a: Get
    get_b: Get
    rules: FieldRules
    by_stamp: bool
    tolerant: bool

    @property
    def _walks(self) -> bool:
        return self.tolerant and not self.by_stamp

    def of(self, gaps: Sequence[Gap], keys_a: Keys, keys_b: Keys) -> Iterator[MessagePair]:
        """Yield what is not the same, in order: messages that belong together, and single ones.

        With tolerances that includes pairs of equal keys, which count as equal.
        """
        if is_turned(keys_a, keys_b):
            turned = replace(self, get_a=self.get_b, get_b=self.get_a)
            for one in turned._of([gap.mirrored for gap in gaps], keys_b, keys_a):
                yield MessagePair(one.b, one.a)
        else:
            yield from self._of(gaps, keys_a, keys_b)

    def _of(self, gaps: Sequence[Gap], keys_a: Keys, keys_b: Keys) -> Iterator[MessagePair]:
        if self._walks:
            yield from self._walk(gaps, keys_a, keys_b)
            return
        for gap in gaps:
            yield from self._within(gap, keys_a, keys_b)

    def _walk(self, gaps: Sequence[Gap], keys_a: Keys, keys_b: Keys) -> Iterator[MessagePair]:
        """Go through all from the first gap to the last: keys that are equal by chance, among many
        that are not but within tolerance, must not decide on what belongs together."""
        i, j, apart = gaps[0].a_start, gaps[0].b_start, 0
        end_a, end_b = gaps[-1].a_end, gaps[-1].b_end
        equal = [(gap.a_end, gap.b_end) for gap in gaps]
        while i < end_a and j < end_b:
            left = end_a - i, end_b - j
            if keys_a[i] == keys_b[j]:
                lead: int | None = 0
            else:
                lead = self._lead(i, j, left, first_of_a=bool(keys_a[i] < keys_b[j]))
            apart = apart + 1 if lead is None else 0
            if apart > LOOKAHEAD:  # lost: on to where they are equal again
                to_a, to_b = next(((x, y) for x, y in equal if x > i and y > j), (end_a, end_b))
                yield from self._within(Gap(i, to_a, j, to_b), keys_a, keys_b)
                i, j, apart = to_a, to_b, 0
            elif lead:
                yield from (MessagePair(at, -1) for at in range(i, i + lead))
                yield from (MessagePair(-1, at) for at in range(j, j - lead))
                i, j = i + max(lead, 0), j + max(-lead, 0)
            else:
                yield MessagePair(i, j)
                i, j = i + 1, j + 1
        yield from (MessagePair(at, -1) for at in range(i, end_a))
        yield from (MessagePair(-1, at) for at in range(j, end_b))

    def _within(self, gap: Gap, keys_a: Keys, keys_b: Keys) -> Iterator[MessagePair]:
        i, j, surplus = gap.a_start, gap.b_start, gap.surplus
        while i < gap.a_end or j < gap.b_end:
            if surplus > 0 and (j >= gap.b_end or self._is_surplus(i, surplus, j, of_b=False)):
                yield MessagePair(i, -1)
                i, surplus = i + 1, surplus - 1
            elif surplus < 0 and (i >= gap.a_end or self._is_surplus(j, -surplus, i, of_b=True)):
                yield MessagePair(-1, j)
                j, surplus = j + 1, surplus + 1
            else:
                if self._walks or keys_a[i] != keys_b[j]:
                    yield MessagePair(i, j)
                i, j = i + 1, j + 1

    def _lead(self, i: int, j: int, left: tuple[int, int], *, first_of_a: bool) -> int | None:
        """Return how many messages only a has here, less than 0 if it is b that has them; 0 if
        these belong together, None if they do not seem to. ``left`` is how many there are in each.
        """
        if self._alike(i, j):
            return 0
        if min(left) > 1 and self._alike(i + 1, j + 1):
            return 0  # one that has changed, among others that have not
        for count in range(1, 1 + LOOKAHEAD):
            for lead in (count, -count) if first_of_a else (-count, count):
                x, y = max(lead, 0), max(-lead, 0)
                rest = left[0] - x, left[1] - y
                if min(rest) < 1 or not self._alike(i + x, j + y):
                    continue
                if min(rest) == 1 or self._alike(i + x + 1, j + y + 1):
                    return lead
        return None

    def _is_surplus(self, at: int, surplus: int, other: int, *, of_b: bool) -> bool:
        """Whether a message of the longer side has no counterpart: a later one fits better."""
        if self.by_stamp:
            return False

        def fits(place: int) -> bool:
            return self._alike(other, place) if of_b else self._alike(place, other)

        later = range(at + 1, at + 1 + min(surplus, LOOKAHEAD))
        return not fits(at) and any(fits(place) for place in later)

    def _alike(self, in_a: int, in_b: int) -> bool:
        """Whether two messages are of one moment: equal within tolerance, or of one header stamp.

        False if one of them is not available or cannot be decoded.
        """
        try:
            one, other = self.get_a(in_a), self.get_b(in_b)
        except TraceError:
            return False
        if one is None or other is None:
            return False
        stamps = []
        for message in (one, other):
            stamp = getattr(getattr(message, "header", None), "stamp", None)
            if stamp is not None:
                stamps.append((stamp.sec, stamp.nanosec))
        if len(stamps) == 2 and stamps[0] == stamps[1] and any(stamps[0]):
            return True
        return all(found.within_tolerance for found in field_differences(one, other, self.rules))
