"""Which messages of a gap belong together: told by what they say, where their keys differ."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from rsltrace.diff.bags.sequences import Gap, Keys
from rsltrace.diff.values.fields import field_differences
from rsltrace.diff.values.globs import FieldRules
from rsltrace.errors import TraceError

LOOKAHEAD = 16
"""How many surplus messages in a row are looked past for the counterpart of one."""

Get = Callable[[int], object | None]
"""Gives the decoded message of an index, None if it is not at hand; may raise TraceError."""


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

    def of(self, gaps: Sequence[Gap], keys_a: Keys, keys_b: Keys) -> Iterator[MessagePair]:
        """Yield what is not the same, in order: messages that belong together, and single ones."""
        for gap in gaps:
            i, j, surplus, apart = gap.a_start, gap.b_start, gap.surplus, 0
            while i < gap.a_end or j < gap.b_end:
                if surplus > 0 and (j >= gap.b_end or self._is_surplus(i, surplus, j, of_b=False)):
                    yield MessagePair(i, -1)
                    i, surplus = i + 1, surplus - 1
                    continue
                if surplus < 0 and (i >= gap.a_end or self._is_surplus(j, -surplus, i, of_b=True)):
                    yield MessagePair(-1, j)
                    j, surplus = j + 1, surplus + 1
                    continue
                if keys_a[i] == keys_b[j]:
                    i, j, apart = i + 1, j + 1, 0
                    continue
                lead: int | None = 0
                if not surplus and self.tolerant and not self.by_stamp:
                    left = min(gap.a_end - i, gap.b_end - j)
                    lead = self._lead(i, j, left, look=apart < LOOKAHEAD)
                    apart = apart + 1 if lead is None else 0
                if not lead:
                    yield MessagePair(i, j)
                    i, j = i + 1, j + 1
                    continue
                surplus = -lead
                for _ in range(abs(lead)):
                    yield MessagePair(i, -1) if lead > 0 else MessagePair(-1, j)
                    i, j = i + (lead > 0), j + (lead < 0)

    def _lead(self, i: int, j: int, left: int, *, look: bool) -> int | None:
        """Return how many messages only a has here, where both have ``left``; less than 0 if it is
        b that has them, 0 if the first ones belong together, None if they do not seem to.

        Two recordings of which one lacks a message here and the other one later are of one length.
        """
        if self._alike(i, j):
            return 0
        if not look:
            return None
        if left > 1 and self._alike(i + 1, j + 1):
            return 0  # one that has changed, among others that have not
        for count in range(1, 1 + min(LOOKAHEAD, left - 1)):
            for lead in (count, -count):
                x, y = i + max(lead, 0), j + max(-lead, 0)
                if self._alike(x, y) and (count == left - 1 or self._alike(x + 1, y + 1)):
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

        Not if one of them is not at hand, or cannot be decoded.
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
