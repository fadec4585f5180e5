"""An event of a trace as a condition sees it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from rsltrace.checks.conditions.names import names_of, topic_of, with_topic_prefix
from rsltrace.checks.conditions.occurrences import TimeCondition, WatchCondition, WhenCondition
from rsltrace.checks.conditions.text import parse_condition
from rsltrace.checks.conditions.view import SentOutput
from rsltrace.errors import ConditionError, TraceError
from rsltrace.trace.model.event import NO_EVENT, NO_SEQUENCE, EventRecord, Output, OutputKind
from rsltrace.trace.model.finding import decode_unseen
from rsltrace.trace.reader import Trace
from rsltrace.trace.segments import event_of, output_of
from rsltrace.trace.words.entities import is_named
from rsltrace.trace.words.logs import log_record
from rsltrace.trace.words.phrases import exception_of

_MESSAGES = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)


@dataclass(frozen=True, slots=True)
class StartOfTrace:
    """The moment at which a run begins: there are no nodes."""

    stamp_ns: int

    @property
    def start_ns(self) -> int:
        """The same."""
        return self.stamp_ns

    def nodes(self) -> dict[str, object]:
        """Return none."""
        return {}


class TraceEvent:
    """An ``EventView`` of an event that has ended, long ago: nodes are not there any more."""

    def __init__(self, trace: Trace, event: EventRecord, outputs: Sequence[Output]) -> None:
        self._trace = trace
        self.event = event
        self.outputs = outputs
        self.index = event.index
        self.kind = int(event.kind)
        self.entity = event.entity
        self.stamp_ns = event.stamp_ns
        self.output_hash = event.output_hash

    @property
    def start_ns(self) -> int:
        """The simulated time at which the run started."""
        return self._trace.start_ns

    @property
    def entity_name(self) -> str:
        """The name of what ran: a topic, a service, a timer's callback."""
        found = self._trace.entities.get(self.entity)
        return "" if found is None else found.name

    @property
    def node(self) -> str:
        """The full name of its node, empty for the run itself."""
        found = self._trace.entities.get(self.entity)
        return "" if found is None or not found.node else self._trace.node_of(found).name

    def nodes(self) -> Mapping[str, object]:
        """Return none: a trace holds what nodes sent, not what they were."""
        return {}

    def received(self) -> tuple[str, object] | None:
        """Return topic and message of the output that caused it, None if that was no message."""
        cause = self.event.cause_event
        if cause == NO_EVENT:
            return None
        outputs = self._trace.outputs_of(cause)
        at = self.event.cause_output
        if not at < len(outputs) or outputs[at].kind not in _MESSAGES:
            return None
        return self._name(outputs[at]), self._message(outputs[at])

    def sent(self) -> Sequence[SentOutput]:
        return [self._sent(output) for output in self.outputs]

    def findings(self) -> Sequence[str]:
        return [one.source.value for one in self._trace.findings.get(self.index, ())]

    def _sent(self, output: Output) -> SentOutput:
        name, kind = self._name(output), int(output.kind)
        if output.kind in _MESSAGES:
            return SentOutput(kind, name, output.hash, message=partial(self._message, output))
        if output.kind is OutputKind.LOG:
            record = log_record(self._trace, output)
            if record is not None:
                return SentOutput(kind, name, output.hash, record.text, record.level)
        text = exception_of(self._trace.detail(output) or "")
        return SentOutput(kind, name, output.hash, text)

    def _name(self, output: Output) -> str:
        return self._trace.entity(output.entity).name

    def _message(self, output: Output) -> object:
        """Decode what was sent. Raises TraceError if that was not kept, or does not fit."""
        channel = self._trace.channel_of(output)
        if channel is None or output.sequence == NO_SEQUENCE:
            raise TraceError(
                f"{self._trace.name} holds no messages of {self._name(output)}, which a check "
                "reads: record them (record: payloads, topics, exclude)"
            )
        return self._trace.decode(channel, self._trace.message(channel.id, output.sequence)[1])


class TraceCondition:
    """A condition that single events of a trace are held against: those that send or receive such
    a message, log such a text, raise, ...

    ``entities`` are those whose events it can be (sorted), None: any.

    :raises ConditionError: it cannot be understood, or no trace says it.
    """

    def __init__(self, text: str, trace: Trace) -> None:
        unseen = decode_unseen(trace.result)
        names = names_of(trace.entities.values(), fields=trace.fields_of, unseen=unseen)
        read = parse_condition(text, names)
        self._armed = read.arm(StartOfTrace(trace.start_ns))
        inner = getattr(self._armed, "inner", self._armed)
        if isinstance(inner, (TimeCondition, WatchCondition, WhenCondition)):
            raise ConditionError(
                "an event of a trace has messages, log records, exceptions and findings: say "
                "/topic: EXPRESSION, log, exception or finding",
                text,
            )
        self._trace = trace
        topic = topic_of(with_topic_prefix(text))
        self.entities: npt.NDArray[np.uint32] | None = None
        if topic is not None:
            ids = sorted(one.id for one in trace.entities.values() if is_named(topic, one.name))
            self.entities = np.array(ids, dtype=np.uint32)

    def holds(self, event: EventRecord, outputs: Sequence[Output]) -> bool:
        """Return whether it is true of an event.

        :raises ConditionError: it cannot be evaluated.
        """
        view = TraceEvent(self._trace, event, outputs)
        return bool(self._armed.before(view) or self._armed.after(view))


def events_of(trace: Trace, topics: Collection[str] | None) -> Iterator[TraceEvent]:
    """Yield the events that have sent something on one of ``topics``; None: all that others can
    see something of."""
    entities = None
    if topics is not None:
        senders = [one.id for one in trace.entities.values() if one.name in topics]
        entities = np.array(senders, dtype=np.uint64)
    findings = np.array(sorted(trace.findings) if entities is None else (), dtype=np.uint64)
    for events, outputs in zip(trace.events(), trace.outputs(), strict=True):
        if not len(events):
            continue
        if entities is not None:
            outputs = outputs[np.isin(outputs["entity"], entities)]
        first, last = events["index"][0], events["index"][-1]
        found = findings[(findings >= first) & (findings <= last)]
        indexes = np.union1d(outputs["event"], found)
        begins = np.searchsorted(outputs["event"], indexes)
        ends = np.searchsorted(outputs["event"], indexes, side="right")
        for index, begin, end in zip(indexes.tolist(), begins.tolist(), ends.tolist(), strict=True):
            event = event_of(events[index - int(first)], trace.name)
            rows = [output_of(row, trace.name) for row in outputs[begin:end]]
            yield TraceEvent(trace, event, rows)
