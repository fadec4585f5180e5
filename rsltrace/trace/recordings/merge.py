"""One stream of messages in time order from many pieces of recording, few of them in memory.

A piece (a chunk, a database) knows the time span of its messages before it is read, so it is
opened only when the stream arrives at its start and dropped when it is used up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from heapq import heappop, heappush

Message = tuple[int, int, bytes]
"""Log time in nanoseconds, index of the topic, CDR bytes."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A piece of recording. ``order`` is its place in the recording, unique.

    ``read`` yields its messages in time order (equal times in file order), none before
    ``start_ns``.
    """

    start_ns: int
    order: int
    read: Callable[[], Iterator[Message]]


def merge(pieces: Iterable[Piece]) -> Iterator[Message]:
    """Yield the messages of all pieces in the order of (time, order of the piece, place in it)."""
    waiting = sorted(pieces, key=lambda piece: (piece.start_ns, piece.order), reverse=True)
    # Entries never compare beyond the order, which is unique.
    opened: list[tuple[int, int, Message, Iterator[Message]]] = []
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
        # The usual case is one open piece: run through it up to where another may come first.
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
