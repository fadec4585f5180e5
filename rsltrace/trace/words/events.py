"""Words for the events of one trace: the node, what ran, and every output."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby

from rsltrace.errors import TraceError
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import (
    EventKind,
    EventRecord,
    Output,
    OutputKind,
    decision_text,
    is_switch,
)
from rsltrace.trace.model.operation import is_built_in
from rsltrace.trace.model.texts import printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.entities import EntityNames, kind_label
from rsltrace.trace.words.logs import log_record
from rsltrace.trace.words.phrases import exception_of

_NAMELESS = frozenset((OutputKind.LOG, OutputKind.EXCEPTION, OutputKind.SHUTDOWN))
"""Kinds that are shown without a name: they belong to the event's node."""


def output_text(kind: int, name: str, entity_kind: str) -> str:
    """Return ``/odom``, ``call /plan``, ``reply /plan``, ``new publisher /map``, ``log``, …

    ``name`` and ``entity_kind`` are those of the entity that the output belongs to.
    """
    if kind == OutputKind.MESSAGE:
        return name
    if kind == OutputKind.REQUEST:
        return f"call {name}"
    if kind == OutputKind.RESPONSE:
        return f"reply {name}"
    if kind == OutputKind.ENTITY:
        return f"new {entity_kind} {name}".rstrip()
    if kind in _NAMELESS:
        return kind_label(OutputKind, kind)
    return f"{kind_label(OutputKind, kind)} {name}".rstrip()


def group_equal(texts: Iterable[str]) -> Iterator[str]:
    """Yield texts; equal neighbours once with their number: ``/odom ×3``."""
    for text, same in groupby(texts):
        count = sum(1 for _ in same)
        yield text if count == 1 else f"{text} ×{count}"


_WITHOUT_DETAIL = frozenset(
    (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE, OutputKind.ENTITY)
)


class EventWords:
    """Words for the events of a trace. Results are printable."""

    def __init__(self, trace: Trace) -> None:
        self._trace = trace
        self._entities = trace.entities
        self.names = EntityNames(trace.entities)

    def node(self, event: EventRecord, outputs: Sequence[Output]) -> str:
        """Return the node of an event: for a constructor the new node; "" for the run."""
        if event.kind is EventKind.CONSTRUCT:
            for output in outputs:
                entity = self._entities.get(output.entity)
                if output.kind is OutputKind.ENTITY and entity and entity.kind is EntityKind.NODE:
                    return self.names.name(entity.id)
        return self.names.node(event.entity)

    def output(self, output: Output) -> str:
        """Return an output with its payload in words: ``log WARN too far``, ``delay 5 ms``."""
        kind, name = output.kind, self.names.name(output.entity)
        if kind is OutputKind.LOG:
            record = log_record(self._trace, output)
            return printable(f"log {record.level_name} {record.text}").rstrip() if record else "log"
        if kind is OutputKind.DRAW:
            place = self._trace.switches.get(output.event) if is_switch(output.hash) else None
            if place:
                return f"another thread goes on before {printable(place)}"
            return f"{decision_text(output.hash)} ({self.names.node(output.entity) or name})"
        entity = self._entities.get(output.entity)
        text = output_text(kind, name, entity.kind.label if entity is not None else "")
        detail = self._detail(output) if kind not in _WITHOUT_DETAIL else ""
        if kind is OutputKind.EXCEPTION:
            return f"{text} {detail}".rstrip()
        return f"{text} ({detail})" if detail else text

    def outputs(
        self, outputs: Sequence[Output], more: Callable[[Output], str] = lambda output: ""
    ) -> Iterator[str]:
        """Yield the outputs of an event, counting repeated ones and those that every node has.

        ``more`` returns an addition for each.
        """
        built_in = 0
        own = []
        for output in outputs:
            if output.kind is OutputKind.ENTITY and self._is_built_in(output.entity):
                built_in += 1
            else:
                own.append(output)
        yield from group_equal(f"{self.output(one)} {more(one)}".rstrip() for one in own)
        if built_in:
            yield f"{built_in} that every node has"

    def _is_built_in(self, entity_id: int) -> bool:
        entity = self._entities.get(entity_id)
        return entity is not None and is_built_in(entity)

    def _detail(self, output: Output) -> str:
        """Return the detail recorded with an output; of an exception without its traceback."""
        try:
            detail = self._trace.detail(output) or ""
        except TraceError as error:
            detail = f"unreadable: {error}"
        if output.kind is OutputKind.EXCEPTION:
            detail = exception_of(detail)
        return printable(detail.strip())
