"""One recording: when each message of each topic was logged, and the messages one looks at."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xxhash

from rsltrace.diff.bags.sequences import Keys, gaps_by_order
from rsltrace.diff.bags.source import open_source
from rsltrace.diff.row_sign import RowSign
from rsltrace.trace.model.texts import NS_PER_S, printable

_KEPT_BYTES = 256 << 20
_PER_STEP = 1000


@dataclass(slots=True)
class Topic:
    """The messages of a topic that are known: their log times (ns), hashes, and bytes (None where
    they were too many to be kept)."""

    number: int
    name: str
    type: str
    stamps: array[int] = field(default_factory=lambda: array("q"))
    hashes: array[int] = field(default_factory=lambda: array("Q"))
    data: list[bytes | None] = field(default_factory=list)

    @property
    def rate_hz(self) -> float | None:
        """How often per second, from the first to the last message; None for fewer than two."""
        if len(self.stamps) < 2 or self.stamps[-1] <= self.stamps[0]:
            return None
        return (len(self.stamps) - 1) * NS_PER_S / (self.stamps[-1] - self.stamps[0])

    @property
    def keys(self) -> Keys:
        """The hashes as a numpy array, shape (messages,)."""
        return np.array(self.hashes, dtype=np.uint64)


class Recording:
    """A recording that is read in the background. ``done`` says whether all of it is known."""

    def __init__(self, path: Path) -> None:
        """Open it. Raises BagError, TraceError."""
        self.path = path
        self._source = open_source(path)
        self._source.close()  # what reads in another thread opens it there
        self.kind = self._source.kind
        self.notes = self._source.notes
        self.topics = [
            Topic(number, topic.name, topic.type)
            for number, topic in enumerate(self._source.topics)
        ]
        self.done = False
        self.start_ns = self.end_ns = 0
        self.count = 0

    @property
    def name(self) -> str:
        """The name without its folder."""
        return printable(self.path.resolve().name)

    def read(self) -> Iterator[int]:
        """Read all messages once; yields how many. Raises BagError, TraceError."""
        kept = 0
        with open_source(self.path) as source:
            for stamp_ns, number, data in source.read(range(len(self.topics))):
                topic = self.topics[number]
                self.start_ns = min(self.start_ns, stamp_ns) if self.count else stamp_ns
                self.end_ns = max(self.end_ns, stamp_ns)
                self.count += 1
                kept += len(data)
                topic.hashes.append(xxhash.xxh3_64_intdigest(data))
                topic.data.append(bytes(data) if kept <= _KEPT_BYTES else None)
                topic.stamps.append(stamp_ns)
                if self.count % _PER_STEP == 0:
                    yield self.count
        self.done = True
        yield self.count

    def message(self, topic: Topic, place: int) -> Iterator[object]:
        """Yield None while looking for a message, and then it, decoded.

        Raises BagError, TraceError; IndexError if there is none.
        """
        data = topic.data[place]
        if data is None:
            with open_source(self.path) as source:
                for count, found in enumerate(source.read([topic.number])):
                    if count == place:
                        data = found[2]
                        break
                    yield None
        if data is not None:
            yield self.decode(topic, data)

    def decode(self, topic: Topic, data: bytes) -> object:
        """Return a decoded message. Raises TraceError."""
        return self._source.decode(topic.number, data)


# The messages of a topic in two recordings, next to each other: which belong together.

_NONE = -1


class Pairs:
    """Rows of a topic. ``a`` and ``b`` are the numbers of messages, -1 for none, shape (rows,)."""

    def __init__(self, a: Topic | None, b: Topic | None) -> None:
        count_a = len(a.stamps) if a is not None else 0
        count_b = len(b.stamps) if b is not None else 0
        self.a: npt.NDArray[np.int64]
        self.b: npt.NDArray[np.int64]
        if a is None or b is None:
            count = max(count_a, count_b)
            numbers, none = np.arange(count), np.full(count, _NONE)
            self.a, self.b = (numbers, none) if a is not None else (none, numbers)
            self.differs = np.ones(count, dtype=np.bool_)
            return
        parts_a, parts_b, differs = [], [], []
        at_a = at_b = 0
        end = (count_a, count_a, count_b, count_b)
        for a_start, a_end, b_start, b_end in [*gaps_by_order(a.keys, b.keys), end]:
            equal = a_start - at_a
            long = max(a_end - a_start, b_end - b_start)
            parts_a += [np.arange(at_a, a_start), _padded(a_start, a_end, long)]
            parts_b += [np.arange(at_b, at_b + equal), _padded(b_start, b_end, long)]
            differs += [np.zeros(equal, dtype=np.bool_), np.ones(long, dtype=np.bool_)]
            at_a, at_b = a_end, b_end
        self.a, self.b = np.concatenate(parts_a), np.concatenate(parts_b)
        self.differs = np.concatenate(differs)

    def of_masks(self, masks: Sequence[npt.NDArray[np.bool_]]) -> npt.NDArray[np.bool_]:
        """Return the rows with a message for which the mask of its recording says yes."""
        found = np.zeros(self.count, dtype=np.bool_)
        for places, mask in zip((self.a, self.b), masks, strict=False):
            there = places >= 0
            found[there] |= mask[places[there]]
        return found

    def only(self, rows: npt.NDArray[np.bool_]) -> Pairs:
        found = copy(self)
        found.a, found.b, found.differs = self.a[rows], self.b[rows], self.differs[rows]
        return found

    @property
    def count(self) -> int:
        return len(self.a)

    def at(self, row: int) -> tuple[int | None, int | None]:
        """Return the numbers of the messages in a row."""
        a, b = int(self.a[row]), int(self.b[row])
        return (a if a >= 0 else None), (b if b >= 0 else None)

    def row_of(self, at: tuple[int | None, int | None]) -> int | None:
        """Return the row with the messages of these numbers (None: whatever there is)."""
        there = np.ones(self.count, dtype=np.bool_)
        for places, number in zip((self.a, self.b), at, strict=True):
            if number is not None:
                there &= places == number
        rows = np.flatnonzero(there)
        return int(rows[0]) if len(rows) else None

    def sign(self, row: int) -> RowSign:
        """Return how a row compares, as far as its bytes tell."""
        a, b = self.at(row)
        if a is None or b is None:
            return RowSign.ONLY_B if a is None else RowSign.ONLY_A
        return RowSign.DIFFERS if self.differs[row] else RowSign.MATCH

    def next_difference(self, row: int, step: int) -> int | None:
        """Return the row after (or before) this one where rows begin to differ."""
        starts = np.flatnonzero(self.differs & ~np.append(False, self.differs[:-1]))
        found = starts[starts > row] if step > 0 else starts[starts < row]
        if not len(found):
            return None
        return int(found[0] if step > 0 else found[-1])


def _padded(start: int, end: int, length: int) -> npt.NDArray[np.int64]:
    return np.append(np.arange(start, end), np.full(length - (end - start), _NONE))
