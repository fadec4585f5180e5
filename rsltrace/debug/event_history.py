"""The events of a debugged run: the last one, and whether each is as in the first run.

The recorder writes to an ``EventLedger`` instead of a file. It keeps what an event sends for one
event, so that conditions can look at it, and compares each chain hash with that of the first run.
"""

from __future__ import annotations

import os
import tempfile
from array import array
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from typing import Any

from rsltrace.guard.redirect import copy_of
from rsltrace.replay.verification import limit_of
from rsltrace.simulation.loop.stop import Stop
from rsltrace.trace.format import EVENT_REST, OUTPUT_CONTENT
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import NO_EVENT, NO_SEQUENCE, EventKind, OutputKind
from rsltrace.trace.model.finding import Finding
from rsltrace.trace.reader import RUN, Trace
from rsltrace.trace.words.events import group_equal, output_text
from rsltrace.trace.writer import TraceWriter

_ROW_BYTES = 8 + EVENT_REST.size
_ROWS_AT_ONCE = 4096
# Not those that a node's guard redirects: they are called in the middle of a run.
_pread = copy_of(os.pread)
_pwrite = copy_of(os.pwrite)
_fstat = copy_of(os.fstat)


class TraceHistory:
    """The events of a trace. ``ended`` says why the run goes no further than ``limit`` events."""

    def __init__(self, trace: Trace) -> None:
        self.trace: Trace | None = trace
        self._trace = trace
        count, self.ended = limit_of(trace, None)
        self._limit = count if count >= 0 else trace.event_count

    descriptors: tuple[int, ...] = ()

    @property
    def limit(self) -> int | None:
        return self._limit

    @property
    def known(self) -> int:
        return self._limit

    def hashes(self, first: int) -> Iterator[int]:
        """Yield the chain hashes of the known events from ``first`` on."""
        for rows in self._trace.events(first):
            yield from rows["chain_hash"].tolist()

    def learn(self, index: int, rest: bytes, chain_hash: int) -> bool:
        """Add an event; return False if the history is complete."""
        return False

    def row(self, index: int) -> tuple[bytes, int]:
        """Return an event, packed, and its chain hash. Raises IndexError."""
        event = self._trace.event(index)
        rest = EVENT_REST.pack(
            event.index,
            event.stamp_ns,
            event.cause_event,
            event.input_hash,
            event.output_hash,
            event.state_hash,
            event.entity,
            event.cause_output,
            event.outputs,
            event.kind,
            event.flags,
        )
        return rest, event.chain_hash


class RunHistory:
    """The events of a run that has never been recorded, in a file that all its processes share."""

    trace: Trace | None = None
    ended: Stop | None = None
    limit: int | None = None

    def __init__(self) -> None:
        with tempfile.TemporaryFile(prefix="rsltrace-debug-") as file:
            self._number = os.dup(file.fileno())

    @property
    def descriptors(self) -> tuple[int, ...]:
        return (self._number,)

    @property
    def known(self) -> int:
        return int(_fstat(self._number).st_size) // _ROW_BYTES

    def hashes(self, first: int) -> Iterator[int]:
        while True:
            data = _pread(self._number, _ROWS_AT_ONCE * _ROW_BYTES, first * _ROW_BYTES)
            whole = len(data) // _ROW_BYTES
            if not whole:
                return
            for start in range(0, whole * _ROW_BYTES, _ROW_BYTES):
                yield int.from_bytes(data[start : start + 8], "little")
            first += whole

    def learn(self, index: int, rest: bytes, chain_hash: int) -> bool:
        row = chain_hash.to_bytes(8, "little") + rest
        _pwrite(self._number, row, index * _ROW_BYTES)
        return True

    def row(self, index: int) -> tuple[bytes, int]:
        data = b""
        if index >= 0:
            data = _pread(self._number, _ROW_BYTES, index * _ROW_BYTES)
        if len(data) < _ROW_BYTES:
            raise IndexError(f"event {index} has not run yet")
        return data[8:], int.from_bytes(data[:8], "little")


EventHistory = TraceHistory | RunHistory

Payload = tuple[int, bytes]
"""The channel of a message, and its canonical CDR."""

_ENOUGH = 1 << 62
DID_MAX = 100


class EventLedger(TraceWriter):
    """The trace writer of a debugged run: keeps the last event and compares each one.

    ``on_difference`` is called when an event differs from its first run. ``entities`` and
    ``channels`` (topic and type) are by id. ``rest`` (packed), ``chain_hash``, ``outputs``
    (packed), ``payloads``, ``details`` and ``findings`` are those of the last event, ``events`` is
    the number of events.
    """

    def __init__(self, history: EventHistory, *, ends_at_size_after: int | None = None) -> None:
        # Nothing of the writer's own: there is no file.
        self.history = history
        self.events = 0
        self.rest = b""
        self.chain_hash = 0
        self.outputs: list[bytes] = []
        self.payloads: list[Payload | str] = []
        self.findings: list[Finding] = []
        self.entities: dict[int, Entity] = {RUN.id: RUN}
        self.channels: dict[int, tuple[str, str]] = {}
        self.on_difference: Callable[[], None] = lambda: None
        self._sequences_under_way = array("I")
        self.sequences = array("I")
        self._outputs_under_way: list[bytes] = []
        self._payloads_under_way: list[Payload | str] = []
        self._findings_under_way: list[Finding] = []
        self.add_output = self._add_output
        self.add_sequence = self._add_sequence
        self._ends_at_size_after = ends_at_size_after
        self._known: Iterator[int] = history.hashes(0)
        self._ids: dict[tuple[str, str], int] = {}

    def _add_output(self, packed: bytes) -> None:
        self._outputs_under_way.append(packed)

    def _add_sequence(self, sequence: int) -> None:
        self._sequences_under_way.append(sequence)

    def add_event(self, rest: bytes, chain_hash: int) -> None:
        outputs = self.outputs
        self.outputs, self._outputs_under_way = self._outputs_under_way, outputs
        outputs.clear()
        sequences = self.sequences
        self.sequences, self._sequences_under_way = self._sequences_under_way, sequences
        if sequences:
            del sequences[:]
        payloads = self.payloads
        self.payloads, self._payloads_under_way = self._payloads_under_way, payloads
        payloads.clear()
        if self.findings or self._findings_under_way:
            self.findings, self._findings_under_way = self._findings_under_way, []
        self.rest, self.chain_hash = rest, chain_hash
        index = self.events
        self.events = index + 1
        known = next(self._known, None)
        if known is None:
            known = self._learn(index, rest, chain_hash)
        if known != chain_hash:
            self.on_difference()

    def _learn(self, index: int, rest: bytes, chain_hash: int) -> int | None:
        """Add an event that the history does not know yet."""
        self._known = self.history.hashes(index)  # another process may have been here meanwhile
        known = next(self._known, None)
        if known is None and self.history.learn(index, rest, chain_hash):
            return chain_hash
        return known

    def add_payload(self, channel_id: int, stamp_ns: int, data: bytes) -> int:
        self._payloads_under_way.append((channel_id, data))
        return len(self._payloads_under_way) - 1

    def add_detail(self, event: int, output: int, stamp_ns: int, text: str) -> int:
        self._payloads_under_way.append(text)
        return len(self._payloads_under_way) - 1

    def add_finding(self, finding: Finding, stamp_ns: int) -> int:
        self._findings_under_way.append(finding)
        return 0

    def add_state(self, event: int, node: int, stamp_ns: int, changes: str) -> int:
        return 0

    def add_entity(self, entity: Entity) -> int:
        self.entities[entity.id] = entity
        return 0

    def add_channel(
        self,
        topic: str,
        type_name: str,
        schema_text: str,
        *,
        qos_yaml: str = "",
        type_hash: str = "",
    ) -> int:
        key = (topic, type_name)
        found = self._ids.get(key)
        if found is None:
            found = self._ids[key] = len(self._ids) + 1
            self.channels[found] = key
        return found

    def add_metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        """Keep nothing: there is no file."""

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Keep nothing: there is no file."""

    def close(self, *, result: Mapping[str, str], replace: bool = True) -> None:
        """Do nothing: there is no file."""

    def abort(self) -> None:
        """Do nothing: there is no file."""

    @property
    def event_count(self) -> int:
        return self.events

    @property
    def size(self) -> int:
        """Enough to end a run that ends by trace size, where the recorded one ended."""
        after = self._ends_at_size_after
        return _ENOUGH if after is not None and self.events >= after else 0

    @property
    def output_hash(self) -> int:
        return int(EVENT_REST.unpack(self.rest)[4]) if self.rest else 0

    def event(self) -> dict[str, Any] | None:
        """Return the last event as an answer, None before the first."""
        if not self.rest:
            return None
        event = event_values(self.rest, self.chain_hash, self.entities)
        event["did"] = list(islice(group_equal(map(self._output_text, self.outputs)), DID_MAX))
        return event

    def _output_text(self, packed: bytes) -> str:
        _, entity_id, kind = OUTPUT_CONTENT.unpack(packed)
        entity = self.entities.get(entity_id, RUN)
        return output_text(kind, entity.name, entity.kind.label)

    def outputs_of_last(self) -> Iterator[tuple[int, int, int, Payload | str | None]]:
        """Yield (kind, entity, hash, payload) of the outputs of the last event."""
        numbers = iter(self.sequences)
        for packed in self.outputs:
            content_hash, entity, kind = OUTPUT_CONTENT.unpack(packed)
            sequence = NO_SEQUENCE if kind == OutputKind.DRAW else next(numbers, NO_SEQUENCE)
            kept = self.payloads[sequence] if sequence < len(self.payloads) else None
            yield kind, entity, content_hash, kept


def event_values(rest: bytes, chain_hash: int, entities: Mapping[int, Entity]) -> dict[str, Any]:
    """Return a packed event as an answer."""
    index, stamp, cause, _, _, state, entity_id, cause_output, outputs, kind, flags = (
        EVENT_REST.unpack(rest)
    )
    entity = entities.get(entity_id, RUN)
    owner = entities.get(entity.node, RUN)
    return {
        "index": index,
        "stamp_ns": stamp,
        "kind": EventKind(kind).label,
        "node": owner.name if owner.id else "",
        "entity": entity.name if entity.id else "",
        "entity_kind": entity.kind.label if entity.id else "",
        "flags": flags,
        "cause_event": None if cause == NO_EVENT else cause,
        "cause_output": cause_output,
        "outputs": outputs,
        "state_hash": f"{state:016x}",
        "chain_hash": f"{chain_hash:016x}",
    }
