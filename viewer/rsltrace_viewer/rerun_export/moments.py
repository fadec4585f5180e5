"""Which event a message came from: what puts messages on the timeline of events.

Rerun's MCAP reader hands out messages with their times only. The outputs of the trace say which
event published on which topic, and an event has a stamp; so the events that published on a topic
at one time, in order, belong to the messages of that topic and time, in order. Only the segments
around the messages at hand are read, whatever the length of the run.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
import rerun as rr

from rsltrace.trace.format import PREFIX_REQUEST, PREFIX_RESPONSE, TOPIC_DETAILS, TOPIC_ROSOUT
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_SEQUENCE, OutputKind
from rsltrace.trace.model.texts import printable
from rsltrace.trace.reader import Trace

# Where things are in Rerun's tree of entities, and what they are called there.
#
#     [run_a/] events                        the table of all events
#            nodes/NODE                      its callbacks, as a lane of states
#            nodes/NODE/log                  its log records, and the tracebacks of exceptions
#            nodes/NODE/rate                 its callbacks per simulated second
#            nodes/NODE/KIND/NAME            the events of one entity, and its rate
#            topics/TOPIC                    its messages as data, and what Rerun draws of them
#            services/SERVICE/request        the same for the messages of services
#     lanes/NODE/a, lanes/NODE/b             of two runs: the lanes, the pairs next to each other
#     frames/FRAME                           of two runs: what joins their frames
#     divergence                             of two runs: what the diff says, and marks
#
# The prefix, ``run_a`` or ``run_b``, is there when two runs are shown.

NO_NODE = "(run)"
"""Where the events are that belong to no node, such as the construction of nodes."""


def join(*parts: str) -> str:
    """Return the entity path of some parts; each may hold slashes, which make more parts."""
    names = [name for part in parts for name in part.split("/") if name]
    return "/" + "/".join(rr.escape_entity_path_part(name) for name in names)


class Paths:
    """The paths of one run. ``label`` is empty for a single run, or ``a`` or ``b``.

    ``root`` is above all of them; it comes behind ``divergence`` in the alphabet, in which the
    viewer lists.
    """

    def __init__(self, label: str, trace: Trace) -> None:
        self.label = label
        self.root = f"run_{label}" if label else ""
        self._trace = trace
        self._ordinals: dict[int, int] = {}
        seen: dict[tuple[int, EntityKind, str], int] = {}
        for entity in trace.entities.values():
            key = (entity.node, entity.kind, entity.name)
            self._ordinals[entity.id] = seen[key] = seen.get(key, 0) + 1

    @property
    def events(self) -> str:
        return join(self.root, "events")

    @property
    def nodes(self) -> str:
        """Above all nodes."""
        return join(self.root, "nodes")

    @property
    def topics(self) -> str:
        """Above all topics."""
        return join(self.root, "topics")

    def node_name(self, entity: Entity) -> str:
        """Return the name of the node that owns an entity, or ``(run)``."""
        owner = self._trace.entities.get(entity.node)
        return printable(owner.name) if owner is not None and owner.name else NO_NODE

    def node(self, name: str) -> str:
        return join(self.root, "nodes", name)

    def lane(self, name: str) -> str:
        """Return the path of a node's lane: those of two runs stand next to each other."""
        return join("lanes", name, self.label) if self.label else self.node(name)

    def callback(self, entity: Entity) -> str:
        """Return the path of an entity that runs callbacks or sends something."""
        if entity.kind in (EntityKind.NODE, EntityKind.SYSTEM):
            return join(self.root, "nodes", self.node_name(entity), entity.kind.label)
        return join(
            self.root, "nodes", self.node_name(entity), entity.kind.label, self.name(entity)
        )

    def name(self, entity: Entity) -> str:
        """Return an entity's name, with a number if its node has several of that name."""
        name = printable(entity.name) or f"{entity.kind.label} {entity.id}"
        ordinal = self._ordinals.get(entity.id, 1)
        return f"{name} #{ordinal}" if ordinal > 1 else name

    def topic(self, topic: str) -> str:
        """Return the path of a topic, or of the request or response side of a service."""
        for prefix, side in ((PREFIX_REQUEST, "request"), (PREFIX_RESPONSE, "response")):
            if topic.startswith(f"{prefix}/"):
                return join(self.root, "services", printable(topic[len(prefix) :]), side)
        return join(self.root, "topics", printable(topic))


Senders = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]
"""Stamps, event indexes and sending entities of what was published, each of shape (n,)."""

_SEGMENTS_CACHED = 16


class Moments:
    """Finds the events behind messages of one trace."""

    def __init__(self, trace: Trace) -> None:
        self._trace = trace
        topic_of = _topics(trace)
        self._topics = ["", *dict.fromkeys(topic_of.values())]
        numbers = {topic: number for number, topic in enumerate(self._topics)}
        self._table = np.zeros((max(trace.entities) + 1, max(OutputKind) + 1), dtype=np.int64)
        for place, topic in topic_of.items():
            self._table[place] = numbers[topic]
        table = trace.segments
        self._starts = table["start_stamp"].astype(np.int64)
        self._ends = table["end_stamp"].astype(np.int64)
        # Stamps do not go backwards, and neither do these, whatever a damaged table says.
        self._ends_sorted = np.maximum.accumulate(self._ends) if len(table) else self._ends
        self._segment = lru_cache(maxsize=_SEGMENTS_CACHED)(self._read_segment)
        self._seen: dict[object, tuple[int, int]] = {}

    def senders(self, topic: str, first_ns: int, last_ns: int) -> Senders:
        """Return what was published on ``topic`` from ``first_ns`` to ``last_ns``, included."""
        low = int(np.searchsorted(self._ends_sorted, first_ns, side="left"))
        parts = []
        for segment in range(low, len(self._starts)):
            if self._starts[segment] > last_ns:
                break
            found = self._segment(segment).get(topic)
            if found is not None:
                keep = (found[0] >= first_ns) & (found[0] <= last_ns)
                parts.append(tuple(column[keep] for column in found))
        if not parts:
            nothing = np.zeros(0, dtype=np.int64)
            return nothing, nothing, nothing
        stamps, events, entities = (np.concatenate(column) for column in zip(*parts, strict=True))
        return stamps, events, entities

    def of_messages(
        self, topic: str, stream: object, stamps_ns: npt.NDArray[np.int64]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return (event indexes, sending entities) of messages, both of shape (n,).

        ``stream`` names the sequence of rows that these continue: messages of one time may be
        split over two calls. A message that no event published (there is none in a whole trace)
        is given to the last event that could have, and entity 0.
        """
        rows = len(stamps_ns)
        if rows == 0:
            return stamps_ns, stamps_ns
        stamps, events, entities = self.senders(
            topic, int(np.min(stamps_ns)), int(np.max(stamps_ns))
        )
        starts = np.flatnonzero(np.diff(stamps_ns, prepend=stamps_ns[0] - 1))
        place = np.arange(rows) - np.repeat(starts, np.diff(starts, append=rows))
        last_ns, count = self._seen.get(stream, (-1, 0))
        if last_ns == stamps_ns[0]:
            place[stamps_ns == last_ns] += count  # only its first run: stamps are sorted
        self._seen[stream] = (int(stamps_ns[-1]), int(place[-1]) + 1)
        if len(stamps) == 0:
            return np.full(rows, self._event_before(int(stamps_ns[0]))), np.zeros_like(stamps_ns)
        first = np.searchsorted(stamps, stamps_ns, side="left")
        past = np.searchsorted(stamps, stamps_ns, side="right")
        # One message may make several rows (the transforms of a /tf): those past the end stay.
        chosen = np.clip(np.minimum(first + place, past - 1), 0, len(stamps) - 1)
        return events[chosen], entities[chosen]

    def _event_before(self, stamp_ns: int) -> int:
        segment = max(int(np.searchsorted(self._starts, stamp_ns, side="right")) - 1, 0)
        return int(self._trace.segments["first_event"][segment]) if len(self._starts) else 0

    def _read_segment(self, segment: int) -> dict[str, Senders]:
        row = self._trace.segments[segment]
        first = int(row["first_event"])
        last = first + int(row["events"])
        events = next(self._trace.events(first, last))
        outputs = next(self._trace.outputs(first, last))
        outputs = outputs[outputs["sequence"] != NO_SEQUENCE]
        owners = outputs["event"].astype(np.int64)
        stamps = events["stamp"][owners - first].astype(np.int64)
        entities = outputs["entity"].astype(np.int64)
        kinds = outputs["kind"].astype(np.int64)
        numbers = self._number_of(entities, kinds)
        order = np.argsort(numbers.astype(np.uint16), kind="stable")
        present, starts = np.unique(numbers[order], return_index=True)
        found = {}
        for number, own in zip(present.tolist(), np.split(order, starts[1:]), strict=True):
            if number:
                found[self._topics[number]] = (stamps[own], owners[own], entities[own])
        return found

    def _number_of(
        self, entities: npt.NDArray[np.int64], kinds: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.int64]:
        """Return the number of the topic of each output, 0 for none."""
        known = (entities < len(self._table)) & (kinds < self._table.shape[1])
        numbers = self._table[np.where(known, entities, 0), np.where(known, kinds, 0)]
        return np.where(known, numbers, 0)


def _topics(trace: Trace) -> dict[tuple[int, int], str]:
    """Return, by (entity, kind of output), the topic on which such outputs are recorded."""
    topics: dict[tuple[int, int], str] = {}
    for entity in trace.entities.values():
        for kind in OutputKind:
            topic = _topic(entity, kind)
            if topic:
                topics[entity.id, int(kind)] = topic
    return topics


def _topic(entity: Entity, kind: OutputKind) -> str:
    if kind is OutputKind.LOG:
        return TOPIC_ROSOUT
    if kind is OutputKind.MESSAGE:
        return entity.name
    if kind is OutputKind.REQUEST:
        return PREFIX_REQUEST + entity.name
    if kind is OutputKind.RESPONSE:
        return PREFIX_RESPONSE + entity.name
    return TOPIC_DETAILS
