"""Which message came of which, and when: one pass over the events of a trace.

Each event has one cause, so each message came on one path; on several where nodes are named of
which a message is taken to come of all that they have received (``ChainSelection.via``).

What happens in a node between taking a message and publishing the next one belongs to the node:
waiting, tasks, calls of services. A callback that was suspended goes on with what it had received.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from rsltrace.checks.latency.paths import NO_PATH, ChainPaths, ChainSelection, Hop, sink_hop
from rsltrace.errors import TraceError
from rsltrace.trace.departures import Departures
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import (
    NO_EVENT,
    EventFlag,
    EventKind,
    OutputKind,
    RandomDecision,
    encode_decision,
)
from rsltrace.trace.model.operation import NODE_TOPICS
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace
from rsltrace.trace.timings import event_columns, timings

# When callbacks of a native run really ended, and when its messages really left and arrived.
#
# In a simulation this follows from what was drawn; there, a clock has it.


class EventDurations:
    """The times of a native run, by the indexes of its events.

    ``durations`` has how long each event took, in ns, shape (events,).
    """

    def __init__(self, trace: Trace) -> None:
        rows = timings(trace)
        events = event_columns(trace)[: len(rows)]
        self.durations: list[int] = rows["duration"].astype(np.int64).tolist()
        known = (rows["source"] != 0) & (events["cause_event"] < np.arange(len(rows)))
        took = rows["ready"].astype(np.int64) - rows["source"].astype(np.int64)
        took[~known | (rows["ready"] == 0)] = NONE
        self._delays: list[int] = np.maximum(took, NONE).tolist()
        self._left = self._sent(rows, events, known)

    def delay_ns(self, event: int) -> int:
        """Return how long the input of an event was on its way; NONE if nobody knows."""
        return self._delays[event]

    def left_ns(self, event: int, output: int, began_ns: int) -> int:
        """Return when a message left that an event sent which began at a time: as whoever received
        it was told, else at the end of the event."""
        return began_ns + self._left.get((event, output), self.durations[event])

    def _sent(
        self,
        rows: npt.NDArray[np.void],
        events: npt.NDArray[np.void],
        known: npt.NDArray[np.bool_],
    ) -> dict[tuple[int, int], int]:
        """Return how long after the start of an event its outputs left, of those received."""
        causes = events["cause_event"][known].astype(np.int64)
        since = rows["source"][known].astype(np.int64) - rows["wall"][causes].astype(np.int64)
        since = np.clip(since, 0, rows["duration"][causes].astype(np.int64))
        keys = zip(causes.tolist(), events["cause_output"][known].tolist(), strict=True)
        return dict(zip(keys, since.tolist(), strict=True))


def native_times(trace: Trace) -> EventDurations | None:
    """Return the times of a native run, None of a simulated one.

    :raises TraceError: the trace is damaged.
    """
    return EventDurations(trace) if is_native(trace) and len(timings(trace)) else None


NONE = -1
"""No message, or none that was received."""
_PLACE_BITS = 24
_STAMP_MAX = 1 << 62
_PATHS_MAX = 256
_MESSAGE, _DRAW = int(OutputKind.MESSAGE), int(OutputKind.DRAW)
_SUBSCRIPTION, _RESUME = int(EventKind.SUBSCRIPTION), int(EventKind.RESUME)
_SUSPENDED = int(EventFlag.SUSPENDED)
_KIND_BITS = encode_decision(1).bit_length() - 1
_VALUE = encode_decision(1) - 1
_LOST = (int(RandomDecision.DROP), int(RandomDecision.BURST), int(RandomDecision.OUTAGE))
_Selected = tuple[int, int, int, int]
"""An output: which of its event's, its kind, entity and hash."""


class IntegerTable:
    """Rows of whole numbers, a column each; 8 bytes for a number."""

    def __init__(self, *columns: str) -> None:
        self._columns = {name: array("q") for name in columns}
        self._appends = [column.append for column in self._columns.values()]
        self._whole: dict[str, npt.NDArray[np.int64]] = {}
        self.count = 0

    def __getitem__(self, column: str) -> array[int]:
        return self._columns[column]

    def add(self, *values: int) -> int:
        """Append a row, a value for each column, and return its number."""
        for append, value in zip(self._appends, values):  # noqa: B905  # checking takes time
            append(value)
        self.count += 1
        return self.count - 1

    def column(self, name: str) -> npt.NDArray[np.int64]:
        """Return a column as an array of shape (rows,), not to be written to."""
        whole = self._whole.get(name)
        if whole is None or len(whole) != self.count:
            whole = self._whole[name] = np.array(self._columns[name], dtype=np.int64)
        return whole


class MessageFlow:
    """What came of what. Times are simulated ns, in a native run those of its clocks.

    ``messages``, a row for each message and path that it came on: ``key`` (of the message), its
    ``path``, ``parent`` (the row of the message that it came of), ``taken`` (the row of how that
    was received), ``began`` (when the stretch of callback began that published it) and
    ``published`` (when it left).
    ``taken``, a row for each callback that received a message: ``message`` (its first row),
    ``rows`` (how many), ``entity``, ``began``, ``delay`` (on its way; NONE: nothing was drawn).
    ``lost``: the first row of the ``message`` and the ``entity`` that did not get it.
    """

    def __init__(self, trace: Trace, wanted: ChainSelection) -> None:
        self.trace = trace
        self.paths = ChainPaths(wanted)
        self.messages = IntegerTable("key", "path", "parent", "taken", "began", "published")
        self.taken = IntegerTable("message", "rows", "entity", "began", "delay")
        self.lost = IntegerTable("message", "entity")
        self._wanted = wanted
        self._all = wanted.first is None
        self._observed = native_times(trace)
        self._delays = IntegerTable("message", "entity", "delay")
        self._of_events = IntegerTable("event", "taken")
        self._suspended: dict[int, deque[int]] = {}
        self._departures = Departures()
        self._last: dict[str, dict[str, int]] = {node: {} for node in wanted.via}
        self._hops: dict[int, int] = {}
        self._nodes: dict[int, str] = {}
        for entity in trace.entities.values():
            owner = trace.entities.get(entity.node)
            self._nodes[entity.id] = "" if owner is None else owner.name
            if entity.kind is EntityKind.PUBLISHER and entity.name not in NODE_TOPICS:
                hop = Hop(self._nodes[entity.id], entity.name)
                self._hops[entity.id] = self.paths.hop(hop)
        self._sink = None if wanted.sink is None else self.paths.hop(sink_hop(wanted.sink))
        self._publishers = np.array(sorted(self._hops), dtype=np.uint32)

    @property
    def sink(self) -> str | None:
        """The node that chains have to end in, if there is one."""
        return self._wanted.sink

    def event_of(self, row: int) -> int:
        """Return the index of the event that published a message."""
        return self.messages["key"][row] >> _PLACE_BITS

    def events_of(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the indexes of the events that published messages."""
        events: npt.NDArray[np.int64] = self.messages.column("key")[rows] >> _PLACE_BITS
        return events

    def node_of(self, entity: int) -> str:
        """Return the name of an entity's node, empty for the run itself."""
        return self._nodes.get(entity, "")

    def read(self, events: npt.NDArray[np.void], outputs: npt.NDArray[np.void]) -> None:
        """Take in the events of a segment, which have to come in order, with their outputs.

        :raises TraceError: it holds what no run does.
        """
        if not len(events):
            return
        if int(events["stamp"].max()) > _STAMP_MAX:
            raise TraceError(f"{self.trace.name}: an event is later than any time of ROS")
        first = int(events["index"][0])
        places = np.arange(len(outputs)) - np.searchsorted(outputs["event"], outputs["event"])
        kinds = outputs["kind"]
        own = (kinds == _MESSAGE) & np.isin(outputs["entity"], self._publishers)
        picked = np.flatnonzero(own | (kinds == _DRAW))
        owners = (outputs["event"][picked] - np.uint64(first)).astype(np.intp)
        sends = np.zeros(len(events), dtype=bool)
        sends[owners] = True
        goes_on = (events["flags"] & _SUSPENDED) != 0
        caused = events["cause_event"] != np.uint64(NO_EVENT)
        kinds = np.isin(events["kind"], (_SUBSCRIPTION, _RESUME))
        chosen = np.flatnonzero(sends | goes_on | caused | kinds)
        bounds = np.searchsorted(owners, np.append(chosen, len(events))).tolist()
        selected = list(
            zip(
                places[picked].tolist(),
                *(outputs[name][picked].tolist() for name in ("kind", "entity", "hash")),
                strict=True,
            )
        )
        fields = ("index", "stamp", "entity", "kind", "flags", "cause_event", "cause_output")
        columns = [events[name][chosen].tolist() for name in fields]
        rows = zip(*columns, pairwise(bounds), strict=True)
        late_ns = self._departures.read(first, events, outputs)
        for index, stamp, entity, kind, flags, cause, nth, (low, high) in rows:
            sent = selected[low:high]
            late = late_ns.get(index, 0)
            self._event(index, stamp, entity, kind, flags, (cause, nth), sent, late)

    def _event(
        self,
        index: int,
        stamp_ns: int,
        entity: int,
        kind: int,
        flags: int,
        cause: tuple[int, int],
        outputs: list[_Selected],
        late_ns: int,
    ) -> None:
        taken = self._came_of(index, stamp_ns, entity, kind, cause)
        busy_ns = late_ns if self._observed is None else self._observed.durations[index]
        if taken != NONE:
            self._of_events.add(index, taken)
        if kind == _SUBSCRIPTION and (received := self._last.get(self.node_of(entity))) is not None:
            received[self.trace.entity(entity).name] = taken  # NONE, too: the one before is gone
        row, follows = NONE, NONE
        for place, what, sender, number in outputs:
            if what == _MESSAGE:
                key = index << _PLACE_BITS | min(place, (1 << _PLACE_BITS) - 2)
                left_ns = stamp_ns + busy_ns
                if self._observed is not None:
                    left_ns = self._observed.left_ns(index, place, stamp_ns)
                row = self._publish(key, sender, stamp_ns, left_ns, taken, entity)
                follows = place
                continue
            draw, value_ns = number >> _KIND_BITS, number & _VALUE
            if row != NONE and place == follows + 1:
                follows = place
                if draw == RandomDecision.DELAY:
                    self._delays.add(row, sender, value_ns)
                elif draw in _LOST:
                    self.lost.add(row, sender)
        done = kind in (_SUBSCRIPTION, _RESUME) and not flags & _SUSPENDED
        if self.sink is not None and done and taken != NONE and self.node_of(entity) == self.sink:
            self._end(index, stamp_ns, stamp_ns + busy_ns, taken)
        if flags & _SUSPENDED:
            self._suspended.setdefault(entity, deque()).append(taken)

    def _end(self, index: int, began_ns: int, done_ns: int, taken: int) -> None:
        """Let the chains end that a callback of the last node has taken a message of."""
        assert self._sink is not None
        key = index << _PLACE_BITS | (1 << _PLACE_BITS) - 1
        first = self.taken["message"][taken]
        for row in range(first, first + self.taken["rows"][taken]):
            path = self.paths.extended(self.messages["path"][row], self._sink)
            if path != NO_PATH:
                self.messages.add(key, path, row, taken, began_ns, done_ns)

    def _came_of(
        self, index: int, stamp_ns: int, entity: int, kind: int, cause: tuple[int, int]
    ) -> int:
        """Return how the message was received that an event goes on with."""
        inherited = NONE
        if cause[0] < index:
            if (taken := self._receive(index, entity, stamp_ns, cause)) != NONE:
                return taken
            if kind != _SUBSCRIPTION:
                inherited = self._of_event(cause[0])
        if kind == _RESUME and (waiting := self._suspended.get(entity)):
            found = inherited if inherited in waiting else waiting[0]
            waiting.remove(found)
            return found
        return inherited

    def _of_event(self, event: int) -> int:
        events = self._of_events["event"]
        at = bisect_left(events, event)
        return self._of_events["taken"][at] if at < len(events) and events[at] == event else NONE

    def _receive(self, index: int, entity: int, stamp_ns: int, cause: tuple[int, int]) -> int:
        """Take note of a message that arrives, if it is one of those on a path."""
        if cause[1] >= 1 << _PLACE_BITS:
            return NONE
        keys = self.messages["key"]
        key = cause[0] << _PLACE_BITS | cause[1]
        row = bisect_left(keys, key)
        last = row
        while last < len(keys) and keys[last] == key:
            last += 1
        if last == row:
            return NONE
        drawn, seen = self._delay(row, entity), self._observed
        delay_ns = drawn if seen is None else seen.delay_ns(index)
        return self.taken.add(row, last - row, entity, stamp_ns, delay_ns)

    def _topic(self, row: int) -> str:
        return self.paths.known[self.paths.hops[self.messages["path"][row]][-1]].topic

    def _delay(self, row: int, entity: int) -> int:
        rows, entities = self._delays["message"], self._delays["entity"]
        at = bisect_left(rows, row)
        while at < len(rows) and rows[at] == row:
            if entities[at] == entity:
                return self._delays["delay"][at]
            at += 1
        return NONE

    def _publish(
        self, key: int, sender: int, began_ns: int, left_ns: int, taken: int, called: int
    ) -> int:
        """Add a message, for each path that it came on; return its first row, if it has one.

        ``called`` is the entity of the event that published it.
        """
        paths, hop, add = self.paths, self._hops[sender], self.messages.add
        first = self.messages.count
        if paths.begins(hop):
            add(key, paths.begun(hop), NONE, NONE, began_ns, left_ns)
        came = False
        of_paths, rows = self.messages["path"], self.taken["rows"]
        for one in self._inputs(sender, taken, called):
            came = True
            parent = self.taken["message"][one]
            for row in range(parent, parent + rows[one]):
                if (path := paths.extended(of_paths[row], hop)) != NO_PATH:
                    add(key, path, row, one, began_ns, left_ns)
        if self._all and not came:
            add(key, paths.begun(hop), NONE, NONE, began_ns, left_ns)
        if self.messages.count - first > _PATHS_MAX:
            name = paths.known[hop]
            raise TraceError(
                f"{self.trace.name}: more than {_PATHS_MAX} chains lead to one message of "
                f"{name.topic} ({name.node}); name one (--chain), or fewer nodes (--via)"
            )
        return first if self.messages.count > first else NONE

    def _inputs(self, sender: int, taken: int, called: int) -> Iterator[int]:
        """Yield how the messages were received that a message comes of."""
        if taken != NONE:
            yield taken
        received = self._last.get(self.node_of(sender)) if self._last else None
        if received:
            if taken != NONE:
                own = self._topic(self.taken["message"][taken])
            else:  # it may go on with a message that came of no input: not of a newer one, then
                one = self.trace.entities.get(called)
                own = one.name if one and one.kind is EntityKind.SUBSCRIPTION else ""
            yield from (took for topic, took in received.items() if topic != own and took != NONE)
