"""Spans as plain values, and back: what one process has observed becomes events of the run.

Each process counts its entities and threads from one; the run gives them numbers of their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple
from itertools import count
from typing import Any

from rsltrace.adapters.rclpy.wire.interfaces import message_type
from rsltrace.native.ledger import Failed, Logged, Scheduled, Sent, Span, Taken
from rsltrace.native.things import Thing, Things
from rsltrace.simulation.middleware.interface import MessageType
from rsltrace.trace.model.entity import Entity, EntityKind

_LOG = "rcl_interfaces/msg/Log"


class SpanWriter:
    """Makes plain values of spans, in the process that was observed."""

    def __init__(self, things: Things) -> None:
        self._things = things
        things.news()
        self._described: set[int] = set()
        self._numbers = count()

    def definitions(self) -> list[tuple[Any, ...]]:
        """Return the entities that have come since this was asked last: before their spans."""
        return [(one.id, one.node, int(one.kind), one.name) for one in self._things.news()]

    def plain(self, span: Span) -> tuple[Any, ...]:
        """Return a span as plain values."""
        span.index = next(self._numbers)
        cause = None
        if span.cause is not None and span.cause[0].index >= 0:
            cause = span.cause[0].index, span.cause[1]
        taken = span.taken
        return (
            int(span.kind),
            _id(span.thing),
            span.start_ns,
            span.wall_ns,
            span.thread,
            None if taken is None else (taken.thing.id, *_fields(taken)),
            cause,
            int(span.flags),
            span.end_ns,
            span.observer_ns,
            [self._output(output) for output in span.outputs],
        )

    def _output(self, output: Any) -> tuple[Any, ...]:
        if isinstance(output, Sent):
            thing = output.thing
            described = None
            if thing.id not in self._described:
                self._described.add(thing.id)
                type = thing.sends or MessageType("")
                described = type.name, *type.describe(), thing.qos_yaml, thing.gid
            values = output.digest, output.data, output.sequence, output.after_ns, output.before_ns
            return "sent", output.kind, thing.id, *values, described
        if isinstance(output, Logged):
            return "logged", output.thing.id, *_fields(output)
        if isinstance(output, Entity):
            id, node, kind, *fields = astuple(output)
            return "entity", id, node, int(kind), *fields
        if isinstance(output, Failed):
            return "failed", *astuple(output)
        return ("task",)


def _id(thing: Thing | None) -> int:
    return 0 if thing is None else thing.id


def _fields(record: Taken | Logged) -> Iterator[Any]:
    """Yield the fields of a record but for its thing, the first."""
    return (getattr(record, name) for name in type(record).__slots__ if name != "thing")


class SpanReader:
    """Makes spans of plain values, in the process of the run; one for each process observed."""

    def __init__(self, ids: Iterator[int], threads: Iterator[int], log_type: Any) -> None:
        """``ids`` and ``threads`` give the next numbers of the run; ``log_type`` is the class of
        log records."""
        self._ids = ids
        self._threads = threads
        self._log_type = log_type
        self._things: dict[int, Thing | None] = {0: None}
        self._own_threads: dict[int, int] = {}
        self._tasks: dict[tuple[int, int], Span] = {}
        self._numbers = count()

    def define(self, definitions: list[tuple[Any, ...]]) -> None:
        """Take note of entities."""
        for id, node, kind, name in definitions:
            number = next(self._ids)
            owner = self._things.get(node)
            thing = Thing(number, number if node == id else 0, EntityKind(kind), name)
            if owner is not None:
                thing.node = owner.id
            self._things[id] = thing

    def span(self, values: tuple[Any, ...]) -> Span:
        """Return a span that ``SpanWriter.plain`` made values of."""
        kind, thing, start_ns, wall_ns, thread, taken, cause, flags, end_ns, observer_ns, made = (
            values
        )
        number = next(self._numbers)
        if thread not in self._own_threads:
            self._own_threads[thread] = next(self._threads)
        span = Span(kind, self._things[thing], start_ns, wall_ns, self._own_threads[thread], None)
        if taken is not None:
            span.taken = Taken(self._thing(taken[0]), *taken[1:])
        if cause in self._tasks:  # a task begins once
            span.cause = self._tasks.pop(cause), cause[1]
        span.flags, span.end_ns, span.observer_ns = flags, end_ns, observer_ns
        span.outputs = [self._output(one) for one in made]
        for place, output in enumerate(span.outputs):
            if isinstance(output, Scheduled):
                self._tasks[number, place] = span
        return span

    def _thing(self, id: int) -> Thing:
        thing = self._things[id]
        assert thing is not None
        return thing

    def _output(self, values: tuple[Any, ...]) -> Any:
        what, *rest = values
        if what == "sent":
            kind, id, *fields, described = rest
            thing = self._thing(id)
            if described is not None:
                name, text, type_hash, thing.qos_yaml, thing.gid = described
                thing.sends = MessageType(name, lambda: (text, type_hash))
            return Sent(kind, thing, *fields)
        if what == "logged":
            thing = self._thing(rest[0])
            thing.sends_type, thing.sends = self._log_type, message_type(self._log_type)
            return Logged(thing, *rest[1:])
        if what == "entity":
            id, _, kind, *fields = rest
            thing = self._thing(id)
            return Entity(thing.id, thing.node, EntityKind(kind), *fields)
        if what == "failed":
            return Failed(*rest)
        return Scheduled()
