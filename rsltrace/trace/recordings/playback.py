"""When the messages of a bag play: by which time, rate, start and number of passes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from heapq import heappop, heappush
from itertools import count

from rsltrace.errors import BagError
from rsltrace.trace.mcap.chunk import PUBLISH_TIME_BYTES
from rsltrace.trace.recordings.reader import Bag
from rsltrace.trace.recordings.topic import BagMessage

BY_LOG_TIME = "log_time"
BY_PUBLISH_TIME = "publish_time"
BY_HEADER_STAMP = "header_stamp"


@dataclass(frozen=True)
class Playback:
    """A bag with its times on the run's clock.

    ``by`` is one of the constants above; ``headers`` are the indices of topics whose messages begin
    with a header. ``rate`` 2 plays in half the time. ``at_ns`` is the time of the first message
    (None: as recorded), ``passes`` how often the bag plays (None: forever); a pass begins when the
    last message of the previous one plays.
    """

    bag: Bag
    by: str = BY_LOG_TIME
    headers: frozenset[int] = frozenset()
    rate: Fraction = Fraction(1)
    at_ns: int | None = None
    passes: int | None = 1

    @property
    def start_ns(self) -> int:
        return self._first_ns if self.at_ns is None else self.at_ns

    @property
    def end_ns(self) -> int | None:
        """The time of the last message, judging by the bag's log times; None: never."""
        if self.passes is None:
            return None
        length_ns = max(self.bag.end_ns - self.bag.start_ns, 0) * self.passes
        return self.start_ns + length_ns * self.rate.denominator // self.rate.numerator

    @property
    def _first_ns(self) -> int:
        if self.by == BY_LOG_TIME:
            return self.bag.start_ns
        first = next(self._ordered(), None)
        assert first is not None, "a bag without messages to play is refused"
        return first[0]

    def messages(self) -> Iterator[BagMessage]:
        """Yield (simulated time, index of the topic, CDR bytes) in playing order."""
        first_ns, start_ns = self._first_ns, self.start_ns
        if self.passes == 1 and first_ns == start_ns and self.rate == 1:
            yield from self._ordered()
            return
        up, down = self.rate.denominator, self.rate.numerator
        for number in count() if self.passes is None else range(self.passes):
            played_ns = start_ns
            for stamp_ns, topic, data in self._ordered():
                played_ns = start_ns + (stamp_ns - first_ns) * up // down
                yield played_ns, topic, data
            if played_ns == start_ns and self.passes is None and number == 0:
                raise BagError(
                    f"{self.bag.path}: all of its messages have one time, so it cannot loop: time "
                    "would never move on"
                )
            start_ns = played_ns

    def _ordered(self) -> Iterator[BagMessage]:
        if self.by == BY_LOG_TIME:
            return self.bag.messages()
        keyed = self._by_publish_time if self.by == BY_PUBLISH_TIME else self._by_header_stamp
        return reordered(keyed)

    def _by_publish_time(self) -> Iterator[BagMessage]:
        for stamp_ns, topic, data in self.bag.with_publish_time():
            publish_ns = int.from_bytes(data[:PUBLISH_TIME_BYTES], "little")
            yield publish_ns or stamp_ns, topic, data[PUBLISH_TIME_BYTES:]

    def _by_header_stamp(self) -> Iterator[BagMessage]:
        for stamp_ns, topic, data in self.bag.messages():
            header_ns = header_stamp_ns(data) if topic in self.headers else 0
            yield header_ns or stamp_ns, topic, data


def header_stamp_ns(data: bytes) -> int:
    """Return the header stamp at the beginning of a CDR message; 0 if it is not set."""
    order = "little" if data[1:2] == b"\x01" else "big"
    sec = int.from_bytes(data[4:8], order, signed=True)  # type: ignore[arg-type]
    nanosec = int.from_bytes(data[8:12], order)  # type: ignore[arg-type]
    return max(sec * 1_000_000_000 + nanosec, 0)


def reordered(messages: Callable[[], Iterator[BagMessage]]) -> Iterator[BagMessage]:
    """Yield messages by time, equal times in their order.

    ``messages`` is read twice: first to find the longest lateness, then to delay each message by
    that. Memory is bounded by the messages within that time.
    """
    latest_ns, late_ns = 0, 0
    for stamp_ns, _, _ in messages():
        latest_ns = max(latest_ns, stamp_ns)
        late_ns = max(late_ns, latest_ns - stamp_ns)
    if late_ns == 0:
        yield from messages()
        return
    waiting: list[tuple[int, int, BagMessage]] = []
    latest_ns = 0
    for number, message in enumerate(messages()):
        latest_ns = max(latest_ns, message[0])
        heappush(waiting, (message[0], number, message))
        while waiting[0][0] < latest_ns - late_ns:
            yield heappop(waiting)[2]
    while waiting:
        yield heappop(waiting)[2]
