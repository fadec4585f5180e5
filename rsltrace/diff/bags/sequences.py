"""Which messages of two sequences belong together, when some may be missing or extra.

Works on keys that are equal for equal messages. What is left unmatched comes out as gaps: ranges
of both sequences between messages that match.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from difflib import SequenceMatcher
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rsltrace.diff.alignment.rows import longest_increasing
from rsltrace.diff.values.fields import field_differences
from rsltrace.diff.values.globs import FieldRules
from rsltrace.errors import TraceError

# Which messages of a gap belong together: decided by content, where their keys differ.

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
        i, j, differing = gaps[0].a_start, gaps[0].b_start, 0
        end_a, end_b = gaps[-1].a_end, gaps[-1].b_end
        equal = [(gap.a_end, gap.b_end) for gap in gaps]
        while i < end_a and j < end_b:
            left = end_a - i, end_b - j
            if keys_a[i] == keys_b[j]:
                lead: int | None = 0
            else:
                lead = self._lead(i, j, left, first_of_a=bool(keys_a[i] < keys_b[j]))
            differing = differing + 1 if lead is None else 0
            if differing > LOOKAHEAD:  # lost: on to where they are equal again
                to_a, to_b = next(((x, y) for x, y in equal if x > i and y > j), (end_a, end_b))
                yield from self._within(Gap(i, to_a, j, to_b), keys_a, keys_b)
                i, j, differing = to_a, to_b, 0
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


Keys = npt.NDArray[np.uint64]
_SMALL = 250_000
"""Up to this many pairs of keys, equal runs of keys that repeat are looked for, too."""


class Gap(NamedTuple):
    """A range of each sequence without a match; one of them may be empty."""

    a_start: int
    a_end: int
    b_start: int
    b_end: int

    @property
    def surplus(self) -> int:
        """How many more there are in a than in b."""
        return (self.a_end - self.a_start) - (self.b_end - self.b_start)

    @property
    def mirrored(self) -> Gap:
        """The same gap with the sequences the other way round."""
        return Gap(self.b_start, self.b_end, self.a_start, self.a_end)


def is_turned(a: Keys, b: Keys) -> bool:
    """Whether b is to be compared with a, and not a with b, so that both orders say the same."""
    if len(a) != len(b):
        return len(a) > len(b)
    different = np.flatnonzero(a != b)
    return len(different) > 0 and bool(a[different[0]] > b[different[0]])


def gaps_by_order(a: Keys, b: Keys, within: list[Gap] | None = None) -> list[Gap]:
    """Return the gaps between two sequences in their order; no gap if they are equal.

    Keys that occur once in both, in the same order, are anchors (as in a patience diff), so one
    message that is missing does not make those after it different. ``within`` are gaps found with
    finer keys: what is between them is known to be equal, whatever its keys.
    """
    outer = [Gap(0, len(a), 0, len(b))] if within is None else within
    if is_turned(a, b):
        turned = [gap.mirrored for gap in outer]
        return [inner.mirrored for gap in turned for inner in _gaps(b, a, gap)]
    return [inner for gap in outer for inner in _gaps(a, b, gap)]


def gaps_by_stamp(a: Keys, b: Keys, stamps_a: Keys, stamps_b: Keys) -> list[Gap]:
    """Return the gaps when messages belong together that have the same stamp (sorted, both).

    Of several messages with one stamp, the first belongs to the first, and so on; if one recording
    has more of them, they belong together by what they say.
    """
    gaps: list[Gap] = []
    i = j = 0
    keys_a, keys_b = a.tolist(), b.tolist()
    times_a, times_b = stamps_a.tolist(), stamps_b.tolist()
    while i < len(keys_a) or j < len(keys_b):
        if j == len(keys_b) or (i < len(keys_a) and times_a[i] < times_b[j]):
            gaps.append(Gap(i, i + 1, j, j))
            i += 1
            continue
        if i == len(keys_a) or times_b[j] < times_a[i]:
            gaps.append(Gap(i, i, j, j + 1))
            j += 1
            continue
        end_a, end_b = (_same_until(times, at) for times, at in ((times_a, i), (times_b, j)))
        if end_a - i == end_b - j:
            for at, other in zip(range(i, end_a), range(j, end_b), strict=True):
                if keys_a[at] != keys_b[other]:
                    gaps.append(Gap(at, at + 1, other, other + 1))
        else:
            gap = Gap(i, end_a, j, end_b)
            if is_turned(a[i:end_a], b[j:end_b]):
                gaps += (inner.mirrored for inner in _gaps(b, a, gap.mirrored))
            else:
                gaps += _gaps(a, b, gap)
        i, j = end_a, end_b
    return gaps


def _same_until(stamps: list[int], at: int) -> int:
    """Return the place behind the last of equal stamps."""
    end = at + 1
    while end < len(stamps) and stamps[end] == stamps[at]:
        end += 1
    return end


def moved_messages(a: Keys, b: Keys, gaps: list[Gap]) -> dict[int, int]:
    """Return the messages that only changed places: index in a, index in b.

    In one place only a has it, in another only b.
    """
    if is_turned(a, b):
        turned = _moved(b, a, [gap.mirrored for gap in gaps])
        return {in_a: in_b for in_b, in_a in turned.items()}
    return _moved(a, b, gaps)


def _moved(a: Keys, b: Keys, gaps: list[Gap]) -> dict[int, int]:
    there: dict[int, list[int]] = {}
    for gap in gaps:
        if gap.a_start == gap.a_end:
            for place in range(gap.b_start, gap.b_end):
                there.setdefault(int(b[place]), []).append(place)
    moved = {}
    for gap in gaps if there else ():
        if gap.b_start == gap.b_end:
            for place in range(gap.a_start, gap.a_end):
                if places := there.get(int(a[place])):
                    moved[place] = places.pop(0)
    return moved


def _gaps(a: Keys, b: Keys, gap: Gap) -> Iterator[Gap]:
    """Yield the gaps within a gap, in order."""
    waiting = [gap]
    while waiting:
        gap = _trimmed(a, b, waiting.pop())
        a_start, a_end, b_start, b_end = gap
        size_a, size_b = a_end - a_start, b_end - b_start
        if not (size_a and size_b):
            if size_a or size_b:
                yield gap
            continue
        anchors = _anchors(a[a_start:a_end], b[b_start:b_end]) if size_a * size_b > 1 else []
        if anchors:
            between = []
            for x, y in anchors:
                between.append(Gap(a_start, gap.a_start + x, b_start, gap.b_start + y))
                a_start, b_start = gap.a_start + x + 1, gap.b_start + y + 1
            waiting += [Gap(a_start, a_end, b_start, b_end), *reversed(between)]
        elif size_a == size_b or size_a * size_b > _SMALL:
            yield gap
        else:
            yield from _matched_gaps(a, b, gap)


def _matched_gaps(a: Keys, b: Keys, gap: Gap) -> Iterator[Gap]:
    a_start, a_end, b_start, b_end = gap
    matcher = SequenceMatcher(
        None, a[a_start:a_end].tolist(), b[b_start:b_end].tolist(), autojunk=False
    )
    for tag, x0, x1, y0, y1 in matcher.get_opcodes():
        if tag != "equal":
            yield Gap(a_start + x0, a_start + x1, b_start + y0, b_start + y1)


def _trimmed(a: Keys, b: Keys, gap: Gap) -> Gap:
    """Return the gap without what is equal at its start and at its end."""
    a_start, a_end, b_start, b_end = gap
    size = min(a_end - a_start, b_end - b_start)
    different = np.flatnonzero(a[a_start : a_start + size] != b[b_start : b_start + size])
    head = int(different[0]) if len(different) else size
    a_start, b_start, size = a_start + head, b_start + head, size - head
    different = np.flatnonzero(a[a_end - size : a_end] != b[b_end - size : b_end])
    tail = size - 1 - int(different[-1]) if len(different) else size
    return Gap(a_start, a_end - tail, b_start, b_end - tail)


def _anchors(a: Keys, b: Keys) -> list[tuple[int, int]]:
    """Return the places of keys that are unique in both, as many as possible in one order."""
    unique_a, first_a, count_a = np.unique(a, return_index=True, return_counts=True)
    unique_b, first_b, count_b = np.unique(b, return_index=True, return_counts=True)
    single_a, single_b = count_a == 1, count_b == 1
    _, in_a, in_b = np.intersect1d(
        unique_a[single_a], unique_b[single_b], assume_unique=True, return_indices=True
    )
    at_a, at_b = first_a[single_a][in_a], first_b[single_b][in_b]
    order = np.argsort(at_a)
    at_a, at_b = at_a[order], at_b[order]
    if len(at_b) and not bool((np.diff(at_b) > 0).all()):
        chosen = sorted(longest_increasing(at_b.tolist()))
        at_a, at_b = at_a[chosen], at_b[chosen]
    return list(zip(at_a.tolist(), at_b.tolist(), strict=True))
