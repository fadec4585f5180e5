"""What the library in a process and the loop say to each other, as bytes (``native/wire.h``)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import Any

from rsltrace.simulation.middleware.qos.policies import (
    INFINITE_NS,
    Durability,
    History,
    Liveliness,
    Qos,
    Reliability,
)

GID_BYTES = 16
NEVER_NS = 2**63 - 1
GRAPH_ID = 2**32 - 1
"""Stands for changes of the graph among the numbers that a process waits for."""

HEAD = struct.Struct("<I")
RECORD = struct.Struct("<II")
GO = struct.Struct("<IIqIII")
"""Length of what follows the first two, what it is, now, thread, what is ready, its number."""
_ADDRESS = struct.Struct("<Q")
_ITEM = struct.Struct("<qqQQ16sI")
_QOS = struct.Struct("<IQIIqqIqI")


class RecordKind(IntEnum):
    """What a process says. The numbers are those of ``native/wire.h``."""

    HELLO = 1
    NODE = 2
    PUBLISHER = 3
    SUBSCRIPTION = 4
    SERVICE = 5
    CLIENT = 6
    TIMER = 7
    GONE = 8
    PUBLISH = 9
    REQUEST = 10
    RESPONSE = 11
    LOG = 12
    REPORT = 13
    TIMER_PASSED = 14
    TIMER_NEXT = 15
    WAIT_SET = 16
    WAIT = 17
    TAKE = 18
    GID = 19
    QOS = 20
    MATCHED = 21
    GRAPH = 22
    ALIVE = 23
    QOS_EVENT = 24
    FOLLOWS = 25
    CALLBACK = 26
    TIMER_OF = 27
    CLOCK_OWNER = 28
    CLOCK = 29
    READY = 30
    DROPPED = 31
    UNSEEN = 32
    DRAW = 33
    SENDER = 34
    CRASH = 35


class CommandKind(IntEnum):
    """Commands to a process."""

    GO = 1
    ANSWER = 2
    STOP = 3
    KILL = 4


class WakeReason(IntEnum):
    """Why a thread goes on."""

    TIMEOUT = 0
    ENTITY = 1
    TIMER = 2
    GRAPH = 4


class WireError(Exception):
    """What a process has sent is none of the library's records."""


class RecordReader:
    """Reads the fields of a record, one after the other.

    :raises WireError: from any of them, if the record is cut off.
    """

    def __init__(self, data: bytes | memoryview) -> None:
        self._data = data
        self._next = 0

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Read several numbers."""
        start, self._next = self._next, self._next + layout.size
        if self._next > len(self._data):
            raise WireError("a process has sent a record that is cut off")
        return layout.unpack_from(self._data, start)

    def number(self) -> int:
        """Read a u32."""
        number: int = self.unpack(HEAD)[0]
        return number

    def blob(self) -> bytes:
        """Read bytes with their length before them."""
        size = self.number()
        start, self._next = self._next, self._next + size
        if self._next > len(self._data):
            raise WireError("a process has sent a record that is cut off")
        return bytes(self._data[start : self._next])

    def text(self) -> str:
        """Read a text; what is no UTF-8 becomes an escape."""
        return self.blob().decode("utf-8", "backslashreplace")

    def frames(self) -> Iterator[tuple[str, int]]:
        """Read a stack: files and addresses in them."""
        for _ in range(self.number()):
            yield self.text(), self.unpack(_ADDRESS)[0]

    def rest(self) -> bytes:
        """Read what is left."""
        return bytes(self._data[self._next :])

    def qos(self) -> Qos:
        """Read a QoS profile."""
        values = self.unpack(_QOS)
        return Qos(
            history=History(values[0]),
            depth=values[1],
            reliability=Reliability(values[2]),
            durability=Durability(values[3]),
            deadline_ns=values[4],
            lifespan_ns=values[5],
            liveliness=Liveliness(values[6]),
            lease_ns=values[7],
            avoid_ros_namespace_conventions=bool(values[8]),
        )


def packed_text(text: str) -> bytes:
    """Return a text with its length before it."""
    data = text.encode("utf-8", "surrogateescape")
    return HEAD.pack(len(data)) + data


def packed_qos(qos: Qos) -> bytes:
    """Return a QoS profile; no limit is the largest time."""
    return _QOS.pack(
        qos.history,
        qos.depth,
        qos.reliability,
        qos.durability,
        qos.deadline_ns or INFINITE_NS,
        qos.lifespan_ns or INFINITE_NS,
        qos.liveliness,
        qos.lease_ns or INFINITE_NS,
        qos.avoid_ros_namespace_conventions,
    )


def packed_item(
    source_ns: int, received_ns: int, number: int, reception: int, gid: bytes, data: bytes
) -> bytes:
    """Return a message, request or response as it is handed over."""
    return _ITEM.pack(source_ns, received_ns, number, reception, gid, len(data)) + data


def changed_item(item: bytes, change: Callable[[bytes], bytes]) -> tuple[bytes, bytes]:
    """Return an item with other data, and that data."""
    source_ns, received_ns, number, reception, gid, _ = _ITEM.unpack_from(item)
    data = change(item[_ITEM.size :])
    return packed_item(source_ns, received_ns, number, reception, gid, data), data


def gid_of(entity_id: int) -> bytes:
    """Return the 16 bytes by which an endpoint is known in the graph."""
    return entity_id.to_bytes(GID_BYTES, "big")
