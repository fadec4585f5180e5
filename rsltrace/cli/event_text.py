"""One event as a line of text or as a JSON object, for ``rsltrace cat``."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from typing import Any

from rsltrace.errors import TraceError
from rsltrace.model.built_in import is_built_in
from rsltrace.model.draw import draw_text
from rsltrace.model.entity import Entity, EntityKind
from rsltrace.model.event import (
    NO_EVENT,
    NO_SEQUENCE,
    Event,
    EventFlag,
    EventKind,
    Output,
    OutputKind,
)
from rsltrace.model.finding import Finding
from rsltrace.model.printable import printable, shortened
from rsltrace.model.stamp import format_seconds
from rsltrace.trace.format import TOPIC_DETAILS
from rsltrace.trace.reader import Trace

_LOG_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}
_VALUE_MAX = 200
_COLUMN_MAX = 40
"""A column is as wide as its longest name, up to here; longer names push the rest to the right."""


class EventText:
    """Writes events as lines of aligned columns.

    Index, simulated seconds, node, kind, entity, input hash, output hash, outputs, flags. Columns
    without a value hold ``-``; outputs and flags come last because they have any length.
    """

    def __init__(self, trace: Trace) -> None:
        self._trace = trace
        self._index_width = max(len(str(trace.event_count)), 5)
        self._time_width = len(format_seconds(trace.end_ns))
        entities = trace.entities.values()
        self._nodes = {e.id: printable(_owner_name(trace, e)) or "-" for e in entities}
        self._names = {e.id: printable(e.name) or "-" for e in entities}
        self._node_width = min(max(map(len, self._nodes.values())), _COLUMN_MAX)
        self._name_width = min(max(map(len, self._names.values())), _COLUMN_MAX)

    def line(self, event: Event, outputs: list[Output]) -> str:
        """Return the line of an event, without a line end."""
        node = self._nodes.get(event.entity, "-")
        if event.kind is EventKind.CONSTRUCT and node == "-":
            node = self._constructed(outputs)
        name = self._names.get(event.entity, f"#{event.entity}")
        columns = (
            f"{event.index:>{self._index_width}}  "
            f"{format_seconds(event.stamp_ns):>{self._time_width}}  "
            f"{node:<{self._node_width}}  {event.kind.label:<15}  {name:<{self._name_width}}  "
            f"{_hex(event.input_hash):<16}  {_hex(event.output_hash):<16}"
        )
        what = ", ".join(self._outputs(outputs))
        flags = "".join(f"  [{name}]" for name in _flag_names(event.flags))
        found = self._trace.findings.get(event.index, ())
        lines = [f"{columns}  {what}{flags}".rstrip(), *map(self._finding, found)]
        return "\n".join(lines)

    def _finding(self, finding: Finding) -> str:
        where = printable(finding.stack.partition("\n")[0])
        return (
            f"{'':>{self._index_width}}  ! {finding.source.value} {finding.mode.value}: "
            f"{printable(finding.call)} -> "
            f"{shortened(printable(finding.value), _VALUE_MAX)}  at {where}"
        )

    def _constructed(self, outputs: list[Output]) -> str:
        """Return the node that a constructor made: the event itself belongs to the run."""
        for output in outputs:
            entity = self._trace.entities.get(output.entity)
            if output.kind is OutputKind.ENTITY and entity and entity.kind is EntityKind.NODE:
                return self._names[entity.id]
        return "-"

    def _outputs(self, outputs: list[Output]) -> Iterator[str]:
        """Yield the outputs; repeated ones, and what every node has, are counted."""
        every = 0
        listed = []
        for output in outputs:
            entity = self._trace.entities.get(output.entity)
            if output.kind is OutputKind.ENTITY and entity is not None and is_built_in(entity):
                every += 1
            else:
                listed.append(self._output(output))
        for text, same in groupby(listed):
            count = len(list(same))
            yield text if count == 1 else f"{text} ×{count}"
        if every:
            yield f"{every} that every node has"

    def _output(self, output: Output) -> str:
        name = self._names.get(output.entity, f"#{output.entity}")
        kind = output.kind
        if kind is OutputKind.MESSAGE:
            return name
        if kind is OutputKind.REQUEST:
            return f"call {name}"
        if kind is OutputKind.RESPONSE:
            return f"reply {name}"
        if kind is OutputKind.LOG:
            level, text = _log(self._trace, output)
            return printable(f"log {level} {text}").rstrip()
        if kind is OutputKind.EXCEPTION:
            lines = (self._trace.detail(output) or "").strip().splitlines()
            return printable(f"exception {lines[-1] if lines else ''}").rstrip()
        if kind is OutputKind.DRAW:
            return f"{draw_text(output.hash)} ({self._nodes.get(output.entity, name)})"
        if kind is OutputKind.ENTITY:
            entity = self._trace.entities.get(output.entity)
            return f"new {entity.kind.label} {name}" if entity else f"new {name}"
        detail = self._trace.detail(output)
        return f"{kind.label} {name}" + (f" ({printable(detail)})" if detail else "")


class EventJson:
    """Makes JSON objects of events; ``payloads`` adds decoded messages."""

    def __init__(self, trace: Trace, *, payloads: bool) -> None:
        self._trace = trace
        self._payloads = payloads

    def object(self, event: Event, outputs: list[Output]) -> dict[str, Any]:
        """Return an event as what ``json`` writes. Times are integers of nanoseconds; hashes are 16
        hex digits, since JSON readers lose digits of 64-bit numbers; what is not there is null."""
        caused = event.cause_event != NO_EVENT
        return {
            "index": event.index,
            "stamp_ns": event.stamp_ns,
            "time": format_seconds(event.stamp_ns),
            "kind": event.kind.label,
            **self._entity(event.entity),
            "cause_event": event.cause_event if caused else None,
            "cause_output": event.cause_output if caused else None,
            "input_hash": f"{event.input_hash:016x}",
            "output_hash": f"{event.output_hash:016x}",
            "state_hash": f"{event.state_hash:016x}" if event.state_hash else None,
            "chain_hash": f"{event.chain_hash:016x}",
            "flags": _flag_names(event.flags),
            "outputs": [self._output(output) for output in outputs],
            "findings": [
                {
                    "source": finding.source.value,
                    "mode": finding.mode.value,
                    "call": finding.call,
                    "value": finding.value,
                    "stack": finding.stack.splitlines(),
                }
                for finding in self._trace.findings.get(event.index, ())
            ],
        }

    def _entity(self, entity_id: int) -> dict[str, Any]:
        entity = self._trace.entities.get(entity_id)
        if entity is None:
            return {"entity": entity_id, "entity_kind": None, "node": None, "name": None}
        return {
            "entity": entity_id,
            "entity_kind": entity.kind.name.lower(),
            "node": _owner_name(self._trace, entity) or None,
            "name": entity.name or None,
        }

    def _output(self, output: Output) -> dict[str, Any]:
        kept = output.sequence != NO_SEQUENCE
        result = {
            "kind": output.kind.label,
            **self._entity(output.entity),
            "hash": f"{output.hash:016x}",
            "sequence": output.sequence if kept else None,
        }
        if output.kind is OutputKind.DRAW:
            result["text"] = draw_text(output.hash)
        if output.kind is OutputKind.LOG and kept:
            result["level"], result["text"] = _log(self._trace, output)
        found = self._trace.payload(output) if kept and self._wants_payload(output) else None
        if found is not None:
            _, topic, data = found
            if topic == TOPIC_DETAILS:
                result["text"] = self._trace.detail(output)
            else:
                from rsltrace.trace.decode import to_plain

                channel = self._trace.channel_of(output)
                assert channel is not None  # it was found a moment ago
                result["topic"] = topic
                result["type"] = channel.type
                result["message"] = to_plain(self._trace.decode(channel, data))
        return result

    def _wants_payload(self, output: Output) -> bool:
        """Details are short and always printed; messages only when asked for."""
        return self._payloads or output.kind not in _WITH_MESSAGE


_WITH_MESSAGE = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE, OutputKind.LOG)


def _log(trace: Trace, output: Output) -> tuple[str, str]:
    """Return level and text of a log record; empty when it was not kept or cannot be decoded."""
    try:
        found = trace.payload(output)
        if found is None:
            return "", ""
        record: Any = trace.decode(found[1], found[2])
        return _LOG_LEVELS.get(record.level, str(record.level)), str(record.msg)
    except (TraceError, AttributeError):
        return "", ""


def _flag_names(flags: EventFlag) -> list[str]:
    # Before Python 3.11, iterating gives the member that stands for no flag, too.
    return [str(flag.name).lower() for flag in EventFlag if flag and flag in flags]


def _owner_name(trace: Trace, entity: Entity) -> str:
    owner = trace.entities.get(entity.node)
    return owner.name if owner is not None else ""


def _hex(value: int) -> str:
    return f"{value:016x}" if value else "-"
