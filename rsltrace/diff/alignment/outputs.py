"""Which output of one event is which of the other's, by what sent them and in which order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from difflib import SequenceMatcher

from rsltrace.diff.alignment.rows import OutputRow

_ALIGNED_MAX = 1000


def matched_outputs(
    a: list[OutputRow], b: list[OutputRow]
) -> Iterator[tuple[int, OutputRow | None, OutputRow | None, bool]]:
    """Yield (position, output of a, of b, whether it only moved) for the outputs that differ.

    Outputs are matched by what sent them, in order. One that is there in both but at another place
    has moved.
    """
    contents_a, contents_b = [x[:3] for x in a], [y[:3] for y in b]
    if contents_a == contents_b:
        return
    if Counter(contents_a) == Counter(contents_b):
        for position, content in enumerate(contents_a):
            if content != contents_b[position]:
                yield position, a[position], b[contents_b.index(content)], True
        return
    pairs = list(_paired(a, b))
    alone_a = {x[:3] for _, x, y in pairs if x is not None and y is None}
    alone_b = {y[:3]: y for _, x, y in pairs if y is not None and x is None}
    for position, x, y in pairs:
        if x is not None and y is not None:
            if x[:3] != y[:3]:
                yield position, x, y, False
        elif x is not None and x[:3] in alone_b:
            yield position, x, alone_b[x[:3]], True
        elif y is None or y[:3] not in alone_a:
            yield position, x, y, False


def _paired(
    a: list[OutputRow], b: list[OutputRow]
) -> Iterator[tuple[int, OutputRow | None, OutputRow | None]]:
    senders_a, senders_b = [x[:2] for x in a], [y[:2] for y in b]
    if senders_a == senders_b or max(len(a), len(b)) > _ALIGNED_MAX:
        for position in range(max(len(a), len(b))):
            x = a[position] if position < len(a) else None
            y = b[position] if position < len(b) else None
            if x and y and x[:2] != y[:2]:
                yield position, x, None
                yield position, None, y
            else:
                yield position, x, y
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
                    x, y = a[begin_a + i + nth], b[begin_b + j + nth]
                    yield begin_a + i + nth, x, y
            else:
                for nth in range(i, i_end):
                    yield begin_a + nth, a[begin_a + nth], None
                for nth in range(j, j_end):
                    yield begin_b + nth, None, b[begin_b + nth]


def different_outputs(a: list[OutputRow], b: list[OutputRow]) -> list[OutputRow]:
    """Return the outputs that only one side has; where one changed into another of the same
    sender, that of ``a``. The order does not matter."""
    if len(a) == len(b) and all(x[:3] == y[:3] for x, y in zip(a, b, strict=True)):
        return []
    if len(a) == 1 == len(b):  # as most events: counting would take ten times as long
        return [*a] if a[0][:2] == b[0][:2] else [*a, *b]
    theirs = Counter(output[:3] for output in b)
    mine = Counter(output[:3] for output in a)
    result = list(beyond(a, theirs))
    changed = Counter(output[:2] for output in result)
    for output in beyond(b, mine):
        if changed[output[:2]] > 0:
            changed[output[:2]] -= 1
        else:
            result.append(output)
    return result


def beyond(outputs: list[OutputRow], others: Counter[tuple[int, int, int]]) -> Iterator[OutputRow]:
    """Yield the outputs of which the others have fewer."""
    left = Counter(others)
    for output in outputs:
        left[output[:3]] -= 1
        if left[output[:3]] < 0:
            yield output
