"""A trace as its file says it, read with the mcap packages and without any code of rsltrace."""

from __future__ import annotations

import math
import re
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.records import Schema

DecoderFactory = pytest.importorskip("mcap_ros2.decoder").DecoderFactory

NOT_RECORDED = 2**32 - 1
_PREFIXES = {2: "/rsltrace/request", 3: "/rsltrace/response"}
_LOG = 4
_ACTION_TYPE = re.compile(r"\b[A-Z]\w*_(SendGoal|GetResult|Feedback|Goal|Result)\w*")


@dataclass
class Message:
    """What an event sent or got: the topic or service, and the paths and values of its fields."""

    name: str
    leaves: list[tuple[str, str]] | None = None
    """None: not a message, or one that was not recorded."""


@dataclass
class Event:
    """An event as it is in the file."""

    index: int
    stamp_ns: int
    node: str
    entity: str
    cause: tuple[int, int]
    outputs: list[Message] = field(default_factory=list)
    input: Message | None = None

    @property
    def messages(self) -> list[Message]:
        """What it sent, and what it got."""
        return [*self.outputs, *([self.input] if self.input is not None else [])]

    @property
    def values(self) -> set[str]:
        """All values of its messages."""
        return {text for one in self.messages for _, text in one.leaves or ()}


def read(path: Path) -> list[Event]:
    """Read a trace."""
    messages: dict[tuple[str, int], list[tuple[str, str]]] = {}
    names: dict[int, str] = {0: ""}
    nodes: dict[int, str] = {0: ""}
    rows: list[tuple[int, ...]] = []
    outputs: list[tuple[int, ...]] = []
    with path.open("rb") as file:
        factory = DecoderFactory()
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            data = message.data[4:]
            if channel.topic == "/rsltrace/events":
                rows.append(struct.unpack("<QQQQQQQIIIBB", data))
            elif channel.topic == "/rsltrace/outputs":
                outputs.append(struct.unpack("<QQIII", data))
            elif not channel.topic.startswith("/rsltrace/details"):
                assert schema is not None
                decoder = factory.decoder_for(channel.message_encoding, _decodable(schema))
                assert decoder is not None
                decoded = decoder(message.data)
                if channel.topic == "/rsltrace/entities":
                    names[decoded.id] = decoded.name
                    nodes[decoded.id] = names.get(decoded.node, "")
                else:
                    messages[channel.topic, message.sequence] = [*leaves_of(decoded)]
    events = [
        Event(index, stamp, nodes.get(entity, ""), names.get(entity, ""), (cause, output))
        for _, index, stamp, cause, _, _, _, entity, output, _, _, _ in rows
    ]
    for event, _, entity, kind, sequence in outputs:
        topic = "/rosout" if kind == _LOG else _PREFIXES.get(kind, "") + names[entity]
        found = messages[topic, sequence] if kind <= _LOG and sequence != NOT_RECORDED else None
        events[event].outputs.append(Message(topic if kind == _LOG else names[entity], found))
    for one in events:
        cause, output = one.cause
        if cause < len(events) and output < len(events[cause].outputs):
            one.input = events[cause].outputs[output]
    return events


def _decodable(schema: Schema) -> Schema:
    """Return a schema without the underscores in names of types of actions, for which the decoder
    has no place."""

    def plain(text: str) -> str:
        return _ACTION_TYPE.sub(lambda name: name[0].replace("_", ""), text)

    return replace(schema, name=plain(schema.name), data=plain(schema.data.decode()).encode())


def leaves_of(message: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield all values in a message with their paths: ``poses[0].position.x``."""
    names = getattr(message, "__slots__", None)
    if names is not None:
        if set(names) == {"sec", "nanosec"}:  # a time is shown in seconds
            yield path, f"{Decimal(message.nanosec).scaleb(-9) + message.sec:f}"
        if set(names) == set("xyzw"):  # a quaternion is shown as the angle of its turn
            x, y, z, w = (getattr(message, name) for name in "xyzw")
            turn = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            yield f"{path}.θ".lstrip("."), str(turn)
        for name in names:
            yield from leaves_of(getattr(message, name), f"{path}.{name}".lstrip("."))
        if {"name", "position"} <= set(names):  # a joint is shown under its own name
            joints = zip(message.name, message.position, strict=False)
            yield from ((name, str(value)) for name, value in joints)
    elif isinstance(message, (list, tuple, bytes, memoryview, array)):
        yield path, f"[{len(message)} item{'' if len(message) == 1 else 's'}]"
        for place, item in enumerate(message):
            yield from leaves_of(item, f"{path}[{place}]")
    else:
        yield path, str(message).lower() if isinstance(message, bool) else str(message)
