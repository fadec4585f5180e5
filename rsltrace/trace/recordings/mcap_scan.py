"""Walking an MCAP recording record by record, where its summary does not tell what is in it.

Messages outside chunks are gathered into runs, so that they are read like chunks later.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, field

from mcap.opcode import Opcode

from rsltrace.trace.mcap.chunk import read_chunk
from rsltrace.trace.mcap.records import MAGIC, MESSAGE, RECORD_HEAD, Damaged, Span, records_in
from rsltrace.trace.mcap.source import ByteSource
from rsltrace.trace.mcap.summary import Summary
from rsltrace.trace.mcap.walk import read_body, walk_records
from rsltrace.trace.model.stamp import format_seconds

RUN_BYTES = 1 << 20
"""Messages outside chunks are read in runs of about this many bytes."""

_CHUNK, _DATA_END, _FOOTER = int(Opcode.CHUNK), int(Opcode.DATA_END), int(Opcode.FOOTER)
_DEFINITIONS = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL)))
_BODY = struct.Struct("<HIQQ")
"""The body of a message up to its data: channel, sequence, log time, publish time."""


@dataclass(frozen=True, slots=True)
class Part:
    """A chunk, or a run of messages outside chunks: whole records.

    ``channels`` are those with messages in it, ``None`` when unknown.
    """

    span: Span
    start_ns: int
    end_ns: int
    channels: frozenset[int] | None
    is_chunk: bool


@dataclass(slots=True)
class McapIndex:
    """Everything about a file that is known before its messages are read.

    ``definitions`` are its schemas and channels. ``data_size`` and ``data_crc`` are those of the
    bytes before the DataEnd record, 0 if unknown.
    """

    profile: str
    definitions: Summary = field(default_factory=Summary)
    parts: list[Part] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    start_ns: int = 0
    end_ns: int = 0
    data_size: int = 0
    data_crc: int = 0
    cut_off: str = ""
    """How much of a file without an end is whole; empty for a complete one."""

    def add(self, span: Span, times: tuple[int, int], counts: Counter[int], is_chunk: bool) -> None:
        """Add a part, its messages counted."""
        self.parts.append(Part(span, *times, frozenset(counts), is_chunk))
        self.counts.update(counts)
        self.start_ns = min(self.start_ns, times[0])
        self.end_ns = max(self.end_ns, times[1])


def scan_file(source: ByteSource, start: int, end: int, index: McapIndex) -> None:
    """Fill ``index`` by walking the file, reading every chunk once. Raises Damaged."""
    index.start_ns, index.end_ns = 2**64 - 1, 0
    scan_records(source, start, end, index, skip_chunks=False)
    if not index.parts:
        index.start_ns = 0


def scan_records(
    source: ByteSource, start: int, end: int, index: McapIndex, *, skip_chunks: bool
) -> bool:
    """Add the records between two places of a file to ``index``. Raises Damaged.

    With ``skip_chunks`` nothing is read of a chunk; finding one ends the walk with ``False``.
    """
    run = _Run()
    for opcode, span in walk_records(source, start, end):
        if opcode == MESSAGE:
            if span.length < RECORD_HEAD.size + _BODY.size:
                raise Damaged(f"the message at byte {span.offset} is too short")
            body = source.read_at(span.offset + RECORD_HEAD.size, _BODY.size)
            channel, _, stamp_ns, _ = _BODY.unpack(body)
            run.add(span, channel, stamp_ns)
            if run.length >= RUN_BYTES:
                run.close(index)
            continue
        run.close(index)
        if opcode == _CHUNK:
            if skip_chunks:
                return False
            _scan_chunk(source, span, index)
        elif opcode in _DEFINITIONS:
            index.definitions.add(opcode, read_body(source, span, opcode))
        elif opcode == _DATA_END:
            index.data_size = span.offset
            index.data_crc = int.from_bytes(read_body(source, span, opcode)[:4], "little")
            break
        elif opcode == _FOOTER:
            break
    run.close(index)
    return True


def _scan_chunk(source: ByteSource, span: Span, index: McapIndex) -> None:
    try:
        records = read_chunk(source, span, strict=False)
        counts: Counter[int] = Counter()
        start_ns, end_ns = 2**64 - 1, 0
        for opcode, at, after in records_in(records):
            if opcode == MESSAGE:
                channel, _, stamp_ns, _ = _BODY.unpack_from(records, at)
                counts[channel] += 1
                start_ns, end_ns = min(start_ns, stamp_ns), max(end_ns, stamp_ns)
            elif opcode in _DEFINITIONS:
                index.definitions.add(opcode, records[at:after])
    except (Damaged, struct.error) as error:
        raise Damaged(f"{error}, in the chunk at byte {span.offset}") from None
    if counts:
        index.add(span, (start_ns, end_ns), counts, is_chunk=True)


class _Run:
    """Collects neighbouring messages outside chunks into one part."""

    def __init__(self) -> None:
        self.length = 0

    def add(self, span: Span, channel: int, stamp_ns: int) -> None:
        if self.length == 0:
            self.offset, self.counts = span.offset, Counter[int]()
            self.start_ns = self.end_ns = stamp_ns
        self.length = span.end - self.offset
        self.counts[channel] += 1
        self.start_ns, self.end_ns = min(self.start_ns, stamp_ns), max(self.end_ns, stamp_ns)

    def close(self, index: McapIndex) -> None:
        if self.length:
            span = Span(self.offset, self.length)
            index.add(span, (self.start_ns, self.end_ns), self.counts, is_chunk=False)
        self.length = 0


def how_far(source: ByteSource) -> tuple[int, str]:
    """Return where the whole part of a file without an end ends, and say what is in it."""
    counts: Counter[int] = Counter()
    good, end_ns = len(MAGIC), 0
    try:
        for opcode, span in walk_records(source, good, source.size):
            good = span.end
            if opcode in (_CHUNK, MESSAGE):
                counts[opcode] += 1
                # The last log time of a chunk, or the log time of a message.
                at = span.offset + RECORD_HEAD.size + (8 if opcode == _CHUNK else 6)
                end_ns = max(end_ns, int.from_bytes(source.read_at(at, 8), "little"))
    except Damaged:
        pass  # The first record that is not whole is what we look for.
    text = f"the first {good} of {source.size} bytes are whole, with {counts[_CHUNK]} chunks"
    if counts[MESSAGE]:
        text += f" and {counts[MESSAGE]} messages outside chunks"
    if counts:
        text += f", up to log time {format_seconds(end_ns)}"
    return good, text
