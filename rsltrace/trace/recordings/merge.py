"""Merge many parts of a recording into one stream of messages by time, with few in memory.

The time span of a part (a chunk, a database) is known before it is read, so it is opened only when
the stream reaches its start, and dropped at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from heapq import heappop, heappush

BagMessage = tuple[int, int, bytes]
"""Log time in nanoseconds, index of the topic, CDR bytes."""


@dataclass(frozen=True, slots=True)
class RecordingPart:
    """A part of a recording. ``order`` is its unique position in the recording.

    ``read`` yields its messages by time (equal times in file order), none before ``start_ns``.
    """

    start_ns: int
    order: int
    read: Callable[[], Iterator[BagMessage]]


def merge(pieces: Iterable[RecordingPart]) -> Iterator[BagMessage]:
    """Yield the messages of all parts by (time, order of the part, position in it)."""
    waiting = sorted(pieces, key=lambda piece: (piece.start_ns, piece.order), reverse=True)
    # The order is unique, so comparisons end there.
    opened: list[tuple[int, int, BagMessage, Iterator[BagMessage]]] = []
    while waiting or opened:
        while waiting and (not opened or (waiting[-1].start_ns, waiting[-1].order) < opened[0][:2]):
            piece = waiting.pop()
            rest = piece.read()
            first = next(rest, None)
            if first is not None:
                heappush(opened, (first[0], piece.order, first, rest))
        if not opened:
            continue
        _, order, message, rest = heappop(opened)
        # Usually one part is open: continue it up to where another may come first.
        limits = [entry[:2] for entry in opened[:1]]
        limits += [(piece.start_ns, piece.order) for piece in waiting[-1:]]
        yield message
        if not limits:
            yield from rest
            continue
        limit_ns, limit_order = min(limits)
        for message in rest:
            stamp_ns = message[0]
            if stamp_ns < limit_ns or (stamp_ns == limit_ns and order < limit_order):
                yield message
            else:
                heappush(opened, (stamp_ns, order, message, rest))
                break
