"""One event as a JSON object, for ``rsltrace cat --json``."""

from __future__ import annotations

from typing import Any

from rsltrace.trace.format import TOPIC_DETAILS
from rsltrace.trace.model.event import (
    NO_EVENT,
    NO_SEQUENCE,
    EventRecord,
    Output,
    OutputKind,
    decision_text,
    is_switch,
)
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.code import code_place, output_places
from rsltrace.trace.words.kinds import flag_names
from rsltrace.trace.words.logs import log_record

_WITH_MESSAGE = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE, OutputKind.LOG)
_WITH_PLACE = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.LOG)


class EventJson:
    """Converts events to JSON objects; ``payloads`` adds decoded messages."""

    def __init__(self, trace: Trace, *, payloads: bool) -> None:
        self._trace = trace
        self._payloads = payloads

    def object(self, event: EventRecord, outputs: list[Output]) -> dict[str, Any]:
        """Return an event as JSON-compatible values. Hashes are 16 hex digits, since JSON readers
        lose digits of 64-bit numbers."""
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
            "code": code_place(self._trace, event) or None,
            "flags": flag_names(event.flags),
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
        owner = self._trace.entities.get(entity.node)
        return {
            "entity": entity_id,
            "entity_kind": entity.kind.name.lower(),
            "node": owner.name or None if owner else None,
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
        if output.kind in _WITH_PLACE or (
            output.kind is OutputKind.DRAW and is_switch(output.hash)
        ):
            result["code"] = output_places(self._trace, output)
        if output.kind is OutputKind.DRAW:
            result["text"] = decision_text(output.hash)
        if output.kind is OutputKind.LOG and kept:
            record = log_record(self._trace, output)
            result["level"] = record.level_name if record else ""
            result["text"] = record.text if record else ""
        found = self._trace.payload(output) if kept and self._wants_payload(output) else None
        if found is not None:
            _, topic, data = found
            if topic == TOPIC_DETAILS:
                result["text"] = self._trace.detail(output)
            else:
                from rsltrace.trace.decode import to_plain

                channel = self._trace.channel_of(output)
                assert channel is not None
                result["topic"] = topic
                result["type"] = channel.type
                result["message"] = to_plain(self._trace.decode(channel, data))
        return result

    def _wants_payload(self, output: Output) -> bool:
        """Details are short and always printed; messages only when asked for."""
        return self._payloads or output.kind not in _WITH_MESSAGE
