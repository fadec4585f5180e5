"""Which output of one event is which of the other's, by what sent them and in which order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import astuple
from difflib import SequenceMatcher

from rsltrace.diff.alignment.rows import OutputRow
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.words.entities import EntityKey

_ALIGNED_MAX = 1000
_RECEIVED = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)

_Place = tuple[int, int, bool]
"""Where an output stands in each of two events (-1: it does not), and whether it only moved."""


def matched_outputs(
    a: list[OutputRow], b: list[OutputRow], keys: Sequence[EntityKey]
) -> Iterator[tuple[int, OutputRow | None, OutputRow | None, bool]]:
    """Yield (position, output of a, of b, whether it only moved) for the outputs that differ.

    Outputs are matched by what sent them (``keys`` by number), in order. One that is there in both
    but at another place has moved. Which are matched, and in which order they come, does not depend
    on which run is a: by position, of two at one position first what others receive.
    """

    def order(place: _Place) -> tuple[int, bool]:
        i, j, _ = place
        kind = a[i][0] if i >= 0 else b[j][0]
        return min(at for at in (i, j) if at >= 0), kind not in _RECEIVED

    if [x[:3] for x in a] == [y[:3] for y in b]:
        return
    if _named(a, keys) <= _named(b, keys):
        places = list(_different(a, b))
    else:
        places = [(i, j, moved) for j, i, moved in _different(b, a)]
    for i, j, moved in sorted(places, key=order):
        x, y = a[i] if i >= 0 else None, b[j] if j >= 0 else None
        yield i if i >= 0 else j, x, y, moved


def _named(outputs: list[OutputRow], keys: Sequence[EntityKey]) -> list[object]:
    return [(kind, astuple(keys[number]), content) for kind, number, content, _ in outputs]


def _different(a: list[OutputRow], b: list[OutputRow]) -> Iterator[_Place]:
    contents_a, contents_b = [x[:3] for x in a], [y[:3] for y in b]
    if Counter(contents_a) == Counter(contents_b):
        first = {content: j for j, content in reversed([*enumerate(contents_b)])}
        for i, content in enumerate(contents_a):
            if content != contents_b[i]:
                yield i, first[content], True
        return
    pairs = list(_paired(a, b))
    alone: dict[tuple[int, int, int], list[int]] = {}
    for i, j in pairs:
        if i < 0:
            alone.setdefault(contents_b[j], []).append(j)
    for i, j in pairs:
        if i >= 0 and j >= 0:
            if contents_a[i] != contents_b[j]:
                yield i, j, False
        elif i >= 0:
            elsewhere = alone.get(contents_a[i])
            yield (i, elsewhere.pop(0), True) if elsewhere else (i, -1, False)
    yield from ((-1, j, False) for places in alone.values() for j in places)


def _paired(a: list[OutputRow], b: list[OutputRow]) -> Iterator[tuple[int, int]]:
    """Yield the places of outputs that may differ, -1 where the other has none."""
    senders_a, senders_b = [x[:2] for x in a], [y[:2] for y in b]
    if senders_a == senders_b or max(len(a), len(b)) > _ALIGNED_MAX:
        for place in range(max(len(a), len(b))):
            i, j = place if place < len(a) else -1, place if place < len(b) else -1
            if min(i, j) >= 0 and senders_a[i] != senders_b[j]:
                yield i, -1
                yield -1, j
            else:
                yield i, j
        return
    # With the content first: of many messages of one publisher, the one that is new is new.
    matcher = SequenceMatcher(None, [x[:3] for x in a], [y[:3] for y in b], autojunk=False)
    for tag, begin_a, end_a, begin_b, end_b in matcher.get_opcodes():
        if tag == "equal":
            continue
        inner = SequenceMatcher(
            None, senders_a[begin_a:end_a], senders_b[begin_b:end_b], autojunk=False
        )
        for inner_tag, i, i_end, j, j_end in inner.get_opcodes():
            if inner_tag == "equal":
                for nth in range(i_end - i):
                    yield begin_a + i + nth, begin_b + j + nth
            else:
                yield from ((begin_a + nth, -1) for nth in range(i, i_end))
                yield from ((-1, begin_b + nth) for nth in range(j, j_end))


def different_outputs(a: list[OutputRow], b: list[OutputRow]) -> list[OutputRow]:
    """Return the outputs that only one side has; where one changed into another of the same
    sender, that of ``a``. The order does not matter."""
    if len(a) == 1 == len(b):  # as most events: counting would take ten times as long
        one, other = a[0], b[0]
        same = one[:2] == other[:2]
        return [] if same and one[2] == other[2] else [*a] if same else [*a, *b]
    if len(a) == len(b) and all(x[:3] == y[:3] for x, y in zip(a, b, strict=True)):
        return []
    result = beyond(a, b)
    changed = Counter(output[:2] for output in result)
    for output in beyond(b, a):
        if changed[output[:2]] > 0:
            changed[output[:2]] -= 1
        else:
            result.append(output)
    return result


def beyond(outputs: list[OutputRow], others: list[OutputRow]) -> list[OutputRow]:
    """Return the outputs of which the others have fewer."""
    return [outputs[place] for place in places_beyond(outputs, others)]


def places_beyond(outputs: list[OutputRow], others: list[OutputRow]) -> Iterator[int]:
    """Yield where the outputs stand of which the others have fewer: of three equal ones and two
    of the others, it is the third."""
    left: dict[tuple[int, int, int], int] = {}
    for output in others:
        left[output[:3]] = left.get(output[:3], 0) + 1
    for place, output in enumerate(outputs):
        count = left.get(output[:3], 0)
        if count:
            left[output[:3]] = count - 1
        else:
            yield place
