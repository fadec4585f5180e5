"""Compare the outputs of a node in two recordings.

Outputs are compared topic by topic (or service, or the log), those of one simulated time in order.
Where one recording has more than the other, an output is missing or new.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rsltrace.diff.facts.evidence import FieldDifference
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.values.fields import WHOLE, diff_messages, preview
from rsltrace.errors import TraceError
from rsltrace.replay.one_node.result import OutputChange, OutputChangeKind
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder
from rsltrace.trace.format import TOPIC_ROSOUT
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_EVENT, Output, OutputKind
from rsltrace.trace.reader import Trace

if TYPE_CHECKING:
    from rsltrace.run.session import RunSession
    from rsltrace.simulation.loop.loop import EventLoop

_COMPARED = (
    OutputKind.MESSAGE,
    OutputKind.REQUEST,
    OutputKind.RESPONSE,
    OutputKind.LOG,
    OutputKind.EXCEPTION,
)
_NOT_KEPT = "(not kept)"
_FIELDS_MAX = 20
Key = tuple[OutputKind, str]


@dataclass(frozen=True, slots=True)
class NodeOutput:
    """An output of a node: time, topic, and its place among all outputs of the node.

    Outputs of two recordings with the same ``at`` are compared, in order.
    """

    stamp_ns: int
    key: Key
    place: int
    output: Output
    at: int


class NodeOutputs:
    def __init__(self, trace: Trace, puts: Sequence[NodeOutput]) -> None:
        self.trace, self.puts = trace, puts

    def decoded(self, put: NodeOutput) -> object | None:
        """Return the decoded output, None if it was not kept or cannot be decoded."""
        trace, output = self.trace, put.output
        if output.kind is OutputKind.EXCEPTION:
            return trace.detail(output)
        channel, payload = trace.channel_of(output), trace.payload(output)
        if channel is None or payload is None:
            return None
        try:
            return trace.decode(channel, payload[2])
        except TraceError:
            return None


def outputs_of_node(trace: Trace, node: str) -> list[NodeOutput]:
    """Return all that a node published, called, answered, logged and raised, in order."""
    entities = trace.entities
    named = [one for one in entities.values() if one.name == node]
    nodes = {one.id for one in named if one.kind is EntityKind.NODE}
    own = {one.id: one.name for one in entities.values() if one.node in nodes}
    found: list[NodeOutput] = []
    for rows, outputs in zip(trace.events(), trace.outputs(), strict=True):
        first = int(rows["index"][0]) if len(rows) else 0
        stamps = rows["stamp"]
        for event, entity, kind, digest, sequence in zip(
            outputs["event"].tolist(),
            outputs["entity"].tolist(),
            outputs["kind"].tolist(),
            outputs["hash"].tolist(),
            outputs["sequence"].tolist(),
            strict=True,
        ):
            if kind in _COMPARED and entity in own:
                kind = OutputKind(kind)
                name = TOPIC_ROSOUT if kind is OutputKind.LOG else own[entity]
                output = Output(event, entity, kind, digest, sequence)
                stamp_ns = int(stamps[event - first])
                found.append(NodeOutput(stamp_ns, (kind, name), len(found), output, stamp_ns))
    return found


def output_changes(
    recorded: NodeOutputs, present: NodeOutputs, options: DiffOptions
) -> Iterator[OutputChange]:
    """Yield the outputs that differ, by time."""
    for before, after in _pairs(recorded.puts, present.puts):
        if before is not None and after is not None:
            if before.output.hash == after.output.hash:
                continue
            fields = _fields(recorded, before, present, after, options)
            if not fields:
                continue  # what differs is ignored, or tolerated
            yield _change(OutputChangeKind.CHANGED, before, before, after, fields)
        elif before is not None:
            whole = FieldDifference(WHOLE, _preview(recorded, before), "")
            yield _change(OutputChangeKind.MISSING, before, before, None, (whole,))
        else:
            assert after is not None
            whole = FieldDifference(WHOLE, "", _preview(present, after))
            yield _change(OutputChangeKind.NEW, after, None, after, (whole,))


def _change(
    what: OutputChangeKind,
    at: NodeOutput,
    before: NodeOutput | None,
    after: NodeOutput | None,
    fields: tuple[FieldDifference, ...],
) -> OutputChange:
    return OutputChange(
        change=what,
        time_ns=at.stamp_ns,
        kind=at.key[0].label,
        name=at.key[1],
        recorded_event=_event(before),
        event=_event(after),
        fields=fields,
    )


def _event(put: NodeOutput | None) -> int | None:
    return None if put is None or put.output.event == NO_EVENT else put.output.event


def _pairs(
    recorded: Sequence[NodeOutput], present: Sequence[NodeOutput]
) -> list[tuple[NodeOutput | None, NodeOutput | None]]:
    waiting: dict[tuple[Key, int], list[NodeOutput]] = {}
    for put in present:
        waiting.setdefault((put.key, put.at), []).append(put)
    for same in waiting.values():
        same.reverse()
    found: list[tuple[NodeOutput | None, NodeOutput | None]] = []
    for put in recorded:
        others = waiting.get((put.key, put.at))
        found.append((put, others.pop() if others else None))
    found += [(None, put) for others in waiting.values() for put in others]
    return sorted(found, key=_place)


def _place(pair: tuple[NodeOutput | None, NodeOutput | None]) -> tuple[int, int]:
    put = pair[0] or pair[1]
    assert put is not None
    return put.stamp_ns, put.place


def _fields(
    recorded: NodeOutputs,
    before: NodeOutput,
    present: NodeOutputs,
    after: NodeOutput,
    options: DiffOptions,
) -> tuple[FieldDifference, ...]:
    a, b = recorded.decoded(before), present.decoded(after)
    if a is None or b is None:
        return (FieldDifference(WHOLE, _preview(recorded, before), _preview(present, after)),)
    found, _ = diff_messages(a, b, options.for_topic(before.key[1]), limit=_FIELDS_MAX)
    return tuple(one for one in found if not one.within_tolerance)


def _preview(side: NodeOutputs, put: NodeOutput) -> str:
    message = side.decoded(put)
    return _NOT_KEPT if message is None else preview(message, 60)


_SENT = frozenset(
    map(int, (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE, OutputKind.LOG))
)


class OutputWatch(EventObserver):
    """Ends the run with ``stop`` at the first output of ``node`` that differs from ``recorded``."""

    order = ObserverOrder.OUTPUTS

    def __init__(self, recorded: Sequence[NodeOutput], node: str, stop: Stop) -> None:
        self._stop = stop
        self._node = node
        self._own: dict[int, str] = {}
        self._nodes: set[int] = set()
        self._in_order = deque(put for put in recorded if put.key[0] is not OutputKind.EXCEPTION)
        self._expected: dict[tuple[int, str], deque[NodeOutput]] = {}
        for put in self._in_order:
            self._expected.setdefault((int(put.key[0]), put.key[1]), deque()).append(put)
        self._met: set[int] = set()
        self._sent: list[tuple[int, int, int]] = []
        self._loop: EventLoop

    def attach(self, session: RunSession) -> None:
        self._loop = session.loop
        session.world.domain.dispatcher.add_observer(self)

    def entity_created(self, entity: Entity) -> None:
        if entity.node == entity.id and entity.name == self._node:
            self._nodes.add(entity.id)
        if entity.node in self._nodes:
            self._own[entity.id] = entity.name

    def output(self, kind: int, entity: int, content_hash: int) -> None:
        if kind in _SENT:
            self._sent.append((kind, entity, content_hash))

    def after_event(self) -> None:
        if not self._as_recorded(self._loop.now_ns):
            self._loop.stop(self._stop)

    def _as_recorded(self, now_ns: int) -> bool:
        """Whether the event's outputs were recorded, and none is missing until now."""
        sent, self._sent = self._sent, []
        for kind, entity, content_hash in sent:
            name = TOPIC_ROSOUT if kind == OutputKind.LOG else self._own.get(entity)
            if entity not in self._own or name is None:
                continue
            expected = self._expected.get((kind, name))
            if not expected:
                return False
            put = expected.popleft()
            self._met.add(put.place)
            if put.stamp_ns != now_ns or put.output.hash != content_hash:
                return False
        waiting = self._in_order
        while waiting and waiting[0].place in self._met:
            self._met.discard(waiting.popleft().place)
        return not waiting or waiting[0].stamp_ns >= now_ns
