"""One recording: when each message of each topic was logged, and the messages one looks at."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xxhash

from rsltrace.diff.bags.sequences import Keys
from rsltrace.diff.bags.source import open_source
from rsltrace.trace.model.printable import printable
from rsltrace.trace.model.stamp import NS_PER_S

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
