"""Who sent what a callback got, by channel, sequence number, content, and publisher or time.

Several publishers of a topic count alike and may say the same. Their gid tells them apart where it
is known; rclpy does not give it. Otherwise what was received was sent (its source timestamp) while
the call that sent it was under way.
"""

from __future__ import annotations

from collections import defaultdict, deque

from rsltrace.native.boundary import channel_of
from rsltrace.native.ledger import Sent, Taken
from rsltrace.trace.model.event import NO_EVENT

KEPT = 200_000
"""Messages sent that are remembered: what comes later than after so many has no known cause."""

SLACK_NS = 1_000_000
"""How far the middleware's clock may be from ours."""

_Key = tuple[str, int, int]
_Place = tuple[int, int, int, int, bytes]


class Causes:
    """Remembers what was sent, and finds it again."""

    def __init__(self, kept: int = KEPT) -> None:
        self._places: defaultdict[_Key, list[_Place]] = defaultdict(list)
        self._order: deque[_Key] = deque()
        self._kept = kept
        self.unknown = 0
        """Messages taken whose sender was not found: another process's, or too old."""

    def sent(self, sent: Sent, event: int, output: int) -> None:
        """Remember which output of which event a message is."""
        key = channel_of(sent.kind, sent.thing.name), sent.sequence, sent.digest
        self._places[key].append((event, output, sent.before_ns, sent.after_ns, sent.thing.gid))
        self._order.append(key)
        if len(self._order) > self._kept:
            oldest = self._order.popleft()
            self._places[oldest].pop(0)
            if not self._places[oldest]:
                del self._places[oldest]

    def of(self, taken: Taken) -> tuple[int, int]:
        """Return the event and output from which an input came; ``NO_EVENT`` if that is unknown."""
        if not taken.channel:
            return NO_EVENT, 0
        places = self._places.get((taken.channel, taken.sequence, taken.digest), ())
        if taken.gid:
            for event, output, *_, gid in places:
                if gid == taken.gid:
                    return event, output
            places = [place for place in places if not place[4]]
        for event, output, before_ns, after_ns, _ in places:
            if before_ns <= taken.source_ns <= after_ns:
                return event, output
        if places and not taken.source_ns:  # of actions, which do not tell when
            return places[-1][:2]
        if len(places) == 1:
            event, output, before_ns, after_ns, _ = places[0]
            if before_ns - SLACK_NS <= taken.source_ns <= after_ns + SLACK_NS:
                return event, output
        self.unknown += 1
        return NO_EVENT, 0
