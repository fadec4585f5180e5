"""Turn what happens in a run into the records of a trace: hashes, numbers, links.

This runs at every callback, so it only packs and hashes. The writer handles the bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from rsltrace.compiled import core
from rsltrace.trace.chain import hash64, identity_hash
from rsltrace.trace.format import EVENT_REST, OUTPUT_CONTENT
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import NO_SEQUENCE, CodeLine, OutputKind
from rsltrace.trace.model.finding import Finding
from rsltrace.trace.writer import TraceWriter

_pack_event = EVENT_REST.pack
_pack_output = OUTPUT_CONTENT.pack
_DRAW = int(OutputKind.DRAW)


class PythonEventChain:
    """The current event, and the hash chain so far. The compiled module has an equal class.

    ``outputs`` and ``output_hash`` belong to the current event; ``end_event`` closes it.
    """

    def __init__(self, writer: TraceWriter) -> None:
        self.index = 0
        self.chain_hash = 0
        self.outputs = 0
        self.output_hash = 0
        self._add_event = writer.add_event
        self._add_output = self._writers_add_output = writer.add_output
        self._add_sequence = writer.add_sequence
        self._add_payload = writer.add_payload

    def tell(self, observers: Sequence[Callable[[int, int, int], None]]) -> None:
        """Call each observer with kind, entity and content hash of every output from now on."""
        add_output = self._writers_add_output
        if not observers:
            self._add_output = add_output
            return

        def tell(packed: bytes) -> None:
            add_output(packed)
            content_hash, entity, kind = OUTPUT_CONTENT.unpack(packed)
            for one in observers:
                one(kind, entity, content_hash)

        self._add_output = tell

    def output(self, kind: int, entity: int, content_hash: int, sequence: int = NO_SEQUENCE) -> int:
        """Add an output to the current event; return its number in it."""
        packed = _pack_output(content_hash, entity, kind)
        self.output_hash = hash64(packed, self.output_hash)
        add_output, add_sequence = self._add_output, self._add_sequence
        add_output(packed)
        add_sequence(sequence)
        position = self.outputs
        self.outputs = position + 1
        return position

    def draw(self, entity: int, draw: int) -> None:
        """Add a random decision to the current event: it has no payload."""
        packed = _pack_output(draw, entity, _DRAW)
        self.output_hash = hash64(packed, self.output_hash)
        add_output = self._add_output
        add_output(packed)
        self.outputs += 1

    def message(
        self, kind: int, entity: int, channel: int, stamp_ns: int, data: bytes, content_hash: int
    ) -> int:
        """Add an output whose payload goes to ``channel`` (negative: hash only)."""
        if channel >= 0:
            add_payload = self._add_payload
            sequence = add_payload(channel, stamp_ns, data)
        else:
            sequence = NO_SEQUENCE
        packed = _pack_output(content_hash, entity, kind)
        self.output_hash = hash64(packed, self.output_hash)
        add_output, add_sequence = self._add_output, self._add_sequence
        add_output(packed)
        add_sequence(sequence)
        position = self.outputs
        self.outputs = position + 1
        return position

    def end_event(
        self,
        stamp_ns: int,
        kind: int,
        flags: int,
        entity: int,
        cause_event: int,
        cause_output: int,
        input_hash: int,
        state_hash: int = 0,
    ) -> None:
        """Close the current event and extend the hash chain."""
        rest = _pack_event(
            self.index,
            stamp_ns,
            cause_event,
            input_hash,
            self.output_hash,
            state_hash,
            entity,
            cause_output,
            self.outputs,
            kind,
            flags,
        )
        self.chain_hash = chain_hash = hash64(rest, self.chain_hash)
        add_event = self._add_event
        add_event(rest, chain_hash)
        self.index += 1
        self.outputs = 0
        self.output_hash = 0


EventChain = PythonEventChain
if core is not None and not TYPE_CHECKING:
    EventChain = core.EventChain


class Recorder(EventChain):
    """Records the events of a run."""

    def __init__(self, writer: TraceWriter, *, keep_payload: Callable[[str], bool]) -> None:
        super().__init__(writer)
        self.writer = writer
        self.keep_payload = keep_payload

    @property
    def digest(self) -> str:
        """The digest of the run so far: the chain hash of the last event."""
        return f"{self.chain_hash:016x}"

    def detail(
        self, kind: OutputKind, entity: int, stamp_ns: int, text: str, content_hash: int
    ) -> int:
        """Add an output described by a text, which is not hashed."""
        sequence = self.writer.add_detail(self.index, self.outputs, stamp_ns, text)
        return self.output(kind, entity, content_hash, sequence)

    def finding(self, finding: Finding, stamp_ns: int) -> None:
        """Record a finding of the guard in the current event. It is not hashed."""
        self.writer.add_finding(finding, stamp_ns)

    def code_line(self, line: CodeLine, stamp_ns: int) -> None:
        """Record a code line. It is not hashed."""
        self.writer.add_code_line(line, stamp_ns)

    def state(self, node: int, stamp_ns: int, changes: str) -> None:
        """Record how a node's state changed in the current event. It is not hashed."""
        self.writer.add_state(self.index, node, stamp_ns, changes)

    def entity(self, entity: Entity) -> None:
        """Record an entity; its identity is part of the event that created it."""
        self.writer.add_entity(entity)
        self.output(OutputKind.ENTITY, entity.id, identity_hash(entity))
