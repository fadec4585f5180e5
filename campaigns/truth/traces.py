"""Traces read with the mcap package and the document of the format alone: what an oracle needs.

Nothing here is of rsltrace: if its reader were wrong, this one would not be wrong in the same way.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader

_EVENT = struct.Struct("<QQQQQQQIIIBB")
_MESSAGE = 1


@dataclass(frozen=True)
class Event:
    """One event: when, whose callback, and all that counts for whether two runs did the same."""

    stamp_ns: int
    node: str
    name: str
    rest: bytes
    kind: int


@dataclass(frozen=True)
class Recorded:
    """What a trace holds. ``messages`` has (stamp, payload) by topic."""

    events: list[Event]
    messages: dict[str, list[tuple[int, bytes]]]
    result: dict[str, str]


def read(path: Path) -> Recorded:
    """Return all of a trace."""
    entities = {0: ("", "")}
    rows: list[bytes] = []
    messages: dict[str, list[tuple[int, bytes]]] = {}
    result: dict[str, str] = {}
    with path.open("rb") as file:
        reader = make_reader(file)
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic == "/rsltrace/entities":
                number, owner, name = _entity(message.data)
                entities[number] = (entities.get(owner, ("", ""))[1], name)
            elif channel.topic == "/rsltrace/events":
                rows.append(message.data[4:])
            elif not channel.topic.startswith("/rsltrace/"):
                messages.setdefault(channel.topic, []).append((message.log_time, message.data))
        for record in reader.iter_metadata():
            if record.name == "rsltrace:result":
                result = dict(record.metadata)
    events = []
    for row in rows:
        values = _EVENT.unpack(row)
        node, name = entities.get(values[7], ("", ""))
        events.append(Event(values[2], node, name, row[8:], values[10]))
    return Recorded(events, messages, result)


def first_difference(a: Recorded, b: Recorded) -> int | None:
    """Return the index of the first event that is not the same, None if all are."""
    for index, (x, y) in enumerate(zip(a.events, b.events, strict=False)):
        if x.rest != y.rest:
            return index
    return None if len(a.events) == len(b.events) else min(len(a.events), len(b.events))


def first_messages(a: Recorded, b: Recorded) -> dict[str, int]:
    """Return for each topic that differs when it first does (another message, or another time)."""
    found = {}
    for topic in {*a.messages, *b.messages}:
        of_a, of_b = a.messages.get(topic, []), b.messages.get(topic, [])
        place = next((i for i, (x, y) in enumerate(zip(of_a, of_b, strict=False)) if x != y), None)
        if place is None and len(of_a) != len(of_b):
            place = min(len(of_a), len(of_b))
        if place is not None:
            found[topic] = min(side[place][0] for side in (of_a, of_b) if place < len(side))
    return found


def number(payload: bytes) -> float:
    """Return the value of a ``std_msgs/msg/Float64``."""
    return float(struct.unpack_from("<d", payload, 4)[0])


def _entity(data: bytes) -> tuple[int, int, str]:
    number_, owner, _ = struct.unpack_from("<IIB", data, 4)
    (length,) = struct.unpack_from("<I", data, 16)
    return number_, owner, data[20 : 20 + length - 1].decode()
