"""Check messages and entities against the hashes of the events, and count a trace.

The chain covers contents by the hashes of outputs. Reading does not compute these again: that needs
the whole file, and damage is found by its checksums.
"""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.trace.cdr import log_content
from rsltrace.trace.chain import hash64, identity_hash
from rsltrace.trace.format import PREFIX_OWN, PREFIX_REQUEST, PREFIX_RESPONSE, TOPIC_ROSOUT
from rsltrace.trace.index import ChannelInfo
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import NO_SEQUENCE, EventKind, Output, OutputKind
from rsltrace.trace.model.texts import NS_PER_S
from rsltrace.trace.reader import Trace

_ENTITY = int(OutputKind.ENTITY)


@dataclass(slots=True)
class Occurrences:
    """Occurrences of something: their number, the first and the last (simulated ns)."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0

    @property
    def rate_hz(self) -> float | None:
        """The rate per simulated second from the first to the last; None for fewer than two."""
        span_ns = self.last_ns - self.first_ns
        return (self.count - 1) * NS_PER_S / span_ns if span_ns > 0 else None

    def add(self, count: int, first_ns: int, last_ns: int) -> None:
        self.first_ns = min(self.first_ns, first_ns) if self.count else first_ns
        self.last_ns = max(self.last_ns, last_ns) if self.count else last_ns
        self.count += count


@dataclass(slots=True)
class TraceCounts:
    """The counts of a whole trace, by entity and by kind.

    The creation of an entity is an output (counted by kind), but not one of that entity.
    """

    events: dict[int, Occurrences] = field(default_factory=dict)
    outputs: dict[int, Occurrences] = field(default_factory=dict)
    starts: dict[int, Occurrences] = field(default_factory=dict)
    """The events of ``events`` in which no coroutine continues."""
    event_kinds: Counter[int] = field(default_factory=Counter)
    output_kinds: Counter[int] = field(default_factory=Counter)

    def rate_hz(self, entity: int) -> float | None:
        """The rate at which an entity ran or, if it never runs (publishers), sent."""
        series = self.starts.get(entity) or self.events.get(entity) or self.outputs.get(entity)
        return series.rate_hz if series else None


CONTINUES = (EventKind.TASK, EventKind.RESUME)
"""Events in which a callback that has begun goes on."""


def count_trace(trace: Trace) -> TraceCounts:
    """Count all events and outputs of ``trace``, a segment at a time.

    Raises TraceError where the trace is damaged.
    """
    counts = TraceCounts()
    for events, outputs in zip(trace.events(), trace.outputs(), strict=True):
        stamps = events["stamp"]
        add_occurrences(counts.events, events["entity"], stamps)
        starts = ~np.isin(events["kind"], CONTINUES)
        add_occurrences(counts.starts, events["entity"][starts], stamps[starts])
        own = outputs[outputs["kind"] != _ENTITY]
        owners = (own["event"] - events["index"][0]).astype(np.intp)
        add_occurrences(counts.outputs, own["entity"], stamps[owners])
        _add_kinds(counts.event_kinds, events["kind"])
        _add_kinds(counts.output_kinds, outputs["kind"])
    return counts


def add_occurrences(
    series: dict[int, Occurrences], entities: npt.NDArray[np.uint32], stamps: npt.NDArray[np.uint64]
) -> None:
    """Add rows to the series of their entities."""
    ids, places, counts = np.unique(entities, return_inverse=True, return_counts=True)
    first = np.full(len(ids), 2**64 - 1, dtype=np.uint64)
    last = np.zeros(len(ids), dtype=np.uint64)
    np.minimum.at(first, places, stamps)
    np.maximum.at(last, places, stamps)
    rows = zip(ids.tolist(), counts.tolist(), first.tolist(), last.tolist(), strict=True)
    for entity, number, first_ns, last_ns in rows:
        series.setdefault(entity, Occurrences()).add(number, first_ns, last_ns)


def _add_kinds(counter: Counter[int], kinds: npt.NDArray[np.unsignedinteger]) -> None:
    values, counts = np.unique(kinds, return_counts=True)
    counter.update(dict(zip(values.tolist(), counts.tolist(), strict=True)))


_WITH_MESSAGE = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE, OutputKind.LOG)


@dataclass(slots=True)
class _ChannelContents:
    """The messages of a channel in order: content hashes (also as log records) and times."""

    hashes: array[int] = field(default_factory=lambda: array("Q"))
    as_logs: array[int] = field(default_factory=lambda: array("Q"))
    stamps: array[int] = field(default_factory=lambda: array("Q"))
    referenced: int = 0
    """The number of them that outputs refer to."""


def check_contents(trace: Trace) -> None:
    """Raise TraceError at a message or entity that does not match an event.

    Reads all messages, with 16 bytes of memory each. Texts of details, findings and states are not
    covered: they are for people.
    """
    messages = _hashed(trace)
    entities: set[int] = set()
    for events, outputs in zip(trace.events(), trace.outputs(), strict=True):
        if not len(outputs):
            continue
        outputs = outputs[np.lexsort((outputs["entity"], outputs["kind"]))]
        stamps = events["stamp"][outputs["event"] - events["index"][0]]
        keys = outputs[["kind", "entity"]]
        begins = np.flatnonzero(np.append(True, keys[1:] != keys[:-1])).tolist()
        for begin, end in pairwise((*begins, len(outputs))):
            kind, entity = keys[begin].item()
            chosen = outputs[begin:end]
            if kind == OutputKind.ENTITY:
                _check_entity(trace, chosen)
                entities.add(entity)
            elif kind in _WITH_MESSAGE:
                kept = chosen["sequence"] != NO_SEQUENCE
                if kept.any():
                    _check_messages(trace, messages, chosen[kept], stamps[begin:end][kept])
    if not trace.complete:
        return  # what events that were never written had to do with may be there
    for channel_id, found in messages.items():
        if found.referenced != len(found.hashes):
            raise _changed_error(
                trace,
                f"{len(found.hashes)} messages on {trace.channels[channel_id].topic} are there, "
                f"and its events refer to {found.referenced}",
            )
    if extra := trace.entities.keys() - entities - {0}:
        raise _changed_error(trace, f"no event has made its entity {min(extra)}")


def _hashed(trace: Trace) -> dict[int, _ChannelContents]:
    channels = {i: channel for i, channel in trace.channels.items() if _has_content(channel)}
    found = {i: _ChannelContents() for i in channels}
    for channel_id, stamp_ns, sequence, data in trace.messages_of(frozenset(channels)):
        of_channel = found[channel_id]
        if sequence != len(of_channel.hashes):
            topic = channels[channel_id].topic
            raise _changed_error(trace, f"message {sequence} on {topic} is out of order")
        of_channel.hashes.append(hash64(data))
        of_channel.stamps.append(stamp_ns)
        if channels[channel_id].topic == TOPIC_ROSOUT:
            of_channel.as_logs.append(hash64(log_content(data, stamp_ns)))
    return found


def _has_content(channel: ChannelInfo) -> bool:
    services = channel.topic.startswith((PREFIX_REQUEST, PREFIX_RESPONSE))
    return services or not channel.topic.startswith(PREFIX_OWN)


def _check_messages(
    trace: Trace,
    messages: dict[int, _ChannelContents],
    outputs: npt.NDArray[np.void],
    stamps: npt.NDArray[np.uint64],
) -> None:
    """Check the messages of outputs of one kind and entity."""
    event, _, entity, kind, sequence = outputs[0].item()
    output = Output(event, entity, OutputKind(kind), 0, sequence)
    channel = trace.channel_of(output)
    found = messages.get(channel.id) if channel is not None else None
    sender = trace.entity(entity)
    topic, type_name = _topic_of(output, sender)
    if channel is None or found is None or (channel.topic, channel.type) != (topic, type_name):
        raise _changed_error(
            trace, f"event {event} sent messages on {topic} ({type_name}), which has no channel"
        )
    numbers = outputs["sequence"].astype(np.int64)
    if int(numbers.max()) >= len(found.hashes):
        raise _changed_error(trace, f"message {int(numbers.max())} on {channel.topic} is missing")
    hashes = found.as_logs if output.kind is OutputKind.LOG else found.hashes
    wrong = np.frombuffer(hashes, dtype=np.uint64)[numbers] != outputs["hash"]
    wrong |= np.frombuffer(found.stamps, dtype=np.uint64)[numbers] != stamps
    if wrong.any():
        at = int(np.argmax(wrong))
        raise _changed_error(
            trace,
            f"message {int(numbers[at])} on {channel.topic} is not the one that event "
            f"{int(outputs['event'][at])} sent",
        )
    found.referenced += len(numbers)


def _topic_of(output: Output, sender: Entity) -> tuple[str, str]:
    if output.kind is OutputKind.LOG:
        return TOPIC_ROSOUT, "rcl_interfaces/msg/Log"
    if output.kind is OutputKind.REQUEST:
        return PREFIX_REQUEST + sender.name, f"{sender.type}_Request"
    if output.kind is OutputKind.RESPONSE:
        return PREFIX_RESPONSE + sender.name, f"{sender.type}_Response"
    return sender.name, sender.type


def _check_entity(trace: Trace, outputs: npt.NDArray[np.void]) -> None:
    event, content_hash, entity, _, _ = outputs[-1].item()
    if content_hash != identity_hash(trace.entity(entity)):
        raise _changed_error(trace, f"entity {entity} is not the one that event {event} made")


def _changed_error(trace: Trace, what: str) -> TraceError:
    return TraceError(f"{trace.name}: {what}; the trace was changed after it was recorded")
