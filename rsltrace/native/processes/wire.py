"""Spans as plain values, and back: what one process has observed becomes events of the run.

Each process counts its entities and threads from one; the run gives them numbers of their own.
"""

from __future__ import annotations

import io
import pickle
import socket
import struct
import threading
from collections.abc import Iterator, Mapping
from dataclasses import astuple, dataclass
from itertools import count
from typing import Any

from rsltrace.adapters.rclpy.messages.interfaces import message_type
from rsltrace.job import Job
from rsltrace.native.observed_entities import ObservedEntities, ObservedEntity
from rsltrace.native.span_recorder import (
    CallbackError,
    CallbackSpan,
    EmittedLog,
    ReceivedInput,
    SentMessage,
    TaskCreation,
)
from rsltrace.simulation.loop.policy import PriorityRule
from rsltrace.simulation.middleware.interface import MessageType
from rsltrace.trace.model.entity import Entity, EntityKind

# Commands to the process of an entry.


@dataclass(frozen=True, slots=True)
class EntryOrder:
    """Which entry of a job's ``nodes:`` to run, or one of these: ``command`` to become another
    program, ``plays_bags`` to play the job's bags.

    ``executor`` is the name of an rclpy class; ``echo`` lets nodes print their log records.
    ``policy`` and its ``rules`` are those of the run's priorities.
    """

    job: Job
    index: int = 0
    executor: str = "SingleThreadedExecutor"
    echo: bool = True
    policy: str | None = None
    rules: tuple[PriorityRule, ...] | None = None
    command: tuple[str, ...] = ()
    environment: Mapping[str, str] | None = None
    """The variables of that program, with the library that observes it; None: it has those of its
    process, and is not observed."""
    plays_bags: bool = False
    module_path: tuple[str, ...] = ()
    """Where the run finds modules."""


# What a native run and the process of one of its entries say to each other: frames on a socket.

_HEAD = struct.Struct("<I")
_PART = 1 << 20

Frame = tuple[Any, ...]
"""A word for what it is about, then values."""


class LinkError(Exception):
    """What came is no frame: something else has written to the socket."""


class _PlainValues(pickle.Unpickler):
    """Reads what a process of user code says: numbers, texts, bytes and lists of them, no objects
    that run code."""

    def find_class(self, module: str, name: str) -> Any:
        raise LinkError(f"{module}.{name} is no plain value")


class Link:
    """One end of the socket. Any thread may send; one receives."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._lock = threading.Lock()
        self._got = bytearray()

    def close_on_exec(self) -> None:
        """Do not leave the socket to the program that this process becomes."""
        self._socket.set_inheritable(False)

    def send(self, *frame: Any) -> None:
        """Send a frame; it waits for as long as the other end does not read.

        :raises OSError: there is no other end any more.
        """
        data = pickle.dumps(frame, protocol=5)
        with self._lock:
            self._socket.sendall(_HEAD.pack(len(data)))
            self._socket.sendall(data)

    def receive(self, *, trusted: bool = False) -> Frame | None:
        """Wait for a frame; None at the end. ``trusted``: it may have objects in it.

        :raises TimeoutError: the socket has a timeout, and it has passed; nothing is lost then.
        :raises LinkError: what came is no frame.
        """
        got = self._got
        size = _HEAD.size
        while len(got) < _HEAD.size or len(got) < (size := _HEAD.size + _HEAD.unpack_from(got)[0]):
            try:
                part = self._socket.recv(max(min(size - len(got), _PART), _HEAD.size))
            except ConnectionResetError:
                part = b""
            if not part:
                return None
            got += part
        data = bytes(got[_HEAD.size : size])
        del got[:size]
        try:
            frame = pickle.loads(data) if trusted else _PlainValues(io.BytesIO(data)).load()
        except Exception as error:
            raise LinkError(str(error)) from error
        if not isinstance(frame, tuple) or not frame:
            raise LinkError("an empty frame")
        return frame

    def close(self) -> None:
        self._socket.close()


class SpanEncoder:
    """Makes plain values of spans, in the process that was observed."""

    def __init__(self, entities: ObservedEntities) -> None:
        self._entities = entities
        entities.news()
        self._described: set[int] = set()
        self._numbers = count()

    def definitions(self) -> list[tuple[Any, ...]]:
        """Return the entities that have come since this was asked last: before their spans."""
        return [(one.id, one.node, int(one.kind), one.name) for one in self._entities.news()]

    def plain(self, span: CallbackSpan) -> tuple[Any, ...]:
        span.index = next(self._numbers)
        cause = None
        if span.cause is not None and span.cause[0].index >= 0:
            cause = span.cause[0].index, span.cause[1]
        taken = span.taken
        return (
            int(span.kind),
            _id(span.entity),
            span.start_ns,
            span.wall_ns,
            span.thread,
            None if taken is None else (taken.entity.id, *_fields(taken)),
            cause,
            int(span.flags),
            span.end_ns,
            span.observer_ns,
            [self._output(output) for output in span.outputs],
        )

    def _output(self, output: Any) -> tuple[Any, ...]:
        if isinstance(output, SentMessage):
            entity = output.entity
            described = None
            if entity.id not in self._described:
                self._described.add(entity.id)
                type = entity.sends or MessageType("")
                described = type.name, *type.describe(), entity.qos_yaml, entity.gid
            values = output.digest, output.data, output.sequence, output.after_ns, output.before_ns
            return "sent", output.kind, entity.id, *values, described
        if isinstance(output, EmittedLog):
            return "logged", output.entity.id, *_fields(output)
        if isinstance(output, Entity):
            id, node, kind, *fields = astuple(output)
            return "entity", id, node, int(kind), *fields
        if isinstance(output, CallbackError):
            return "failed", *astuple(output)
        return ("task",)


def _id(entity: ObservedEntity | None) -> int:
    return 0 if entity is None else entity.id


def _fields(record: ReceivedInput | EmittedLog) -> Iterator[Any]:
    """Yield the fields of a record but for its entity, the first."""
    return (getattr(record, name) for name in type(record).__slots__ if name != "entity")


class SpanDecoder:
    """Makes spans of plain values, in the process of the run; one for each process observed."""

    def __init__(self, ids: Iterator[int], threads: Iterator[int], log_type: Any) -> None:
        """``ids`` and ``threads`` give the next numbers of the run; ``log_type`` is the class of
        log records."""
        self._ids = ids
        self._threads = threads
        self._log_type = log_type
        self._entities: dict[int, ObservedEntity | None] = {0: None}
        self._own_threads: dict[int, int] = {}
        self._tasks: dict[tuple[int, int], CallbackSpan] = {}
        self._numbers = count()

    def define(self, definitions: list[tuple[Any, ...]]) -> None:
        """Take note of entities."""
        for id, node, kind, name in definitions:
            number = next(self._ids)
            owner = self._entities.get(node)
            entity = ObservedEntity(number, number if node == id else 0, EntityKind(kind), name)
            if owner is not None:
                entity.node = owner.id
            self._entities[id] = entity

    def span(self, values: tuple[Any, ...]) -> CallbackSpan:
        """Return a span that ``SpanEncoder.plain`` made values of."""
        kind, entity, start_ns, wall_ns, thread, taken, cause, flags, end_ns, observer_ns, made = (
            values
        )
        number = next(self._numbers)
        if thread not in self._own_threads:
            self._own_threads[thread] = next(self._threads)
        span = CallbackSpan(
            kind, self._entities[entity], start_ns, wall_ns, self._own_threads[thread], None
        )
        if taken is not None:
            span.taken = ReceivedInput(self._entity(taken[0]), *taken[1:])
        if cause in self._tasks:  # a task begins once
            span.cause = self._tasks.pop(cause), cause[1]
        span.flags, span.end_ns, span.observer_ns = flags, end_ns, observer_ns
        span.outputs = [self._output(one) for one in made]
        for place, output in enumerate(span.outputs):
            if isinstance(output, TaskCreation):
                self._tasks[number, place] = span
        return span

    def _entity(self, id: int) -> ObservedEntity:
        entity = self._entities[id]
        assert entity is not None
        return entity

    def _output(self, values: tuple[Any, ...]) -> Any:
        what, *rest = values
        if what == "sent":
            kind, id, *fields, described = rest
            entity = self._entity(id)
            if described is not None:
                name, text, type_hash, entity.qos_yaml, entity.gid = described
                entity.sends = MessageType(name, lambda: (text, type_hash))
            return SentMessage(kind, entity, *fields)
        if what == "logged":
            entity = self._entity(rest[0])
            entity.sends_type, entity.sends = self._log_type, message_type(self._log_type)
            return EmittedLog(entity, *rest[1:])
        if what == "entity":
            id, _, kind, *fields = rest
            entity = self._entity(id)
            return Entity(entity.id, entity.node, EntityKind(kind), *fields)
        if what == "failed":
            return CallbackError(*rest)
        return TaskCreation()
