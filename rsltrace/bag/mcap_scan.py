"""Walking an MCAP file record by record, where its summary does not tell what is in it.

Messages outside chunks are gathered into runs, so that they are read like chunks later.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from rsltrace.bag.mcap_chunk import iterate_records, read_chunk
from rsltrace.bag.mcap_records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    RECORD_HEAD,
    SCHEMA,
    Channel,
    Schema,
    parse_channel,
    parse_schema,
)
from rsltrace.model.stamp import format_seconds

RUN_BYTES = 1 << 20
"""Messages outside chunks are read in runs of about this many bytes."""


@dataclass(frozen=True, slots=True)
class Span:
    """A chunk, or a run of messages outside chunks: whole records at ``offset``.

    ``channels`` are those with messages in it, ``None`` when unknown.
    """

    offset: int
    length: int
    start_ns: int
    end_ns: int
    channels: frozenset[int] | None
    is_chunk: bool


@dataclass(slots=True)
class McapIndex:
    """Everything about a file that is known before its messages are read.

    ``data_size`` and ``data_crc`` are those of the bytes before the DataEnd record, 0 if unknown.
    """

    profile: str
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    spans: list[Span] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    start_ns: int = 0
    end_ns: int = 0
    data_size: int = 0
    data_crc: int = 0
    cut_off: str = ""
    """How much of a file without an end is whole; empty for a complete one."""


def scan_file(file: BinaryIO, start: int, end: int, index: McapIndex) -> None:
    """Fill ``index`` by walking the file, reading every chunk once."""
    index.start_ns, index.end_ns = 2**64 - 1, 0
    scan_records(file, start, end, index, skip_chunks=False)
    if not index.spans:
        index.start_ns = 0


def scan_records(
    file: BinaryIO, start: int, end: int, index: McapIndex, *, skip_chunks: bool
) -> bool:
    """Add the records between two places of a file to ``index``.

    With ``skip_chunks`` nothing is read of a chunk; finding one ends the walk with ``False``.
    """
    run = _Run()
    for opcode, at, after in walk_records(file, start, end):
        if opcode == MESSAGE:
            file.seek(at)
            head = file.read(MESSAGE_HEAD.size - 8)
            if after - at < len(head):
                raise ValueError(f"the message at byte {at} is too short")
            _, channel, _, stamp_ns, _ = MESSAGE_HEAD.unpack(bytes(8) + head)
            run.add(at - RECORD_HEAD.size, after, channel, stamp_ns)
            if run.length >= RUN_BYTES:
                run.close(index)
            continue
        run.close(index)
        if opcode == CHUNK:
            if skip_chunks:
                return False
            _scan_chunk(file, at - RECORD_HEAD.size, after, index)
        elif opcode in (SCHEMA, CHANNEL):
            file.seek(at)
            _define(opcode, file.read(after - at), index)
        elif opcode == DATA_END:
            file.seek(at)
            index.data_size = at - RECORD_HEAD.size
            index.data_crc = int.from_bytes(file.read(4), "little")
            break
        elif opcode == FOOTER:
            break
    run.close(index)
    return True


def _scan_chunk(file: BinaryIO, offset: int, end: int, index: McapIndex) -> None:
    try:
        data = read_chunk(file, offset, end - offset)
        counts: Counter[int] = Counter()
        start_ns, end_ns = 2**64 - 1, 0
        for opcode, at, after in iterate_records(data):
            if opcode == MESSAGE:
                _, channel, _, stamp_ns, _ = MESSAGE_HEAD.unpack_from(data, at - 8)
                counts[channel] += 1
                start_ns, end_ns = min(start_ns, stamp_ns), max(end_ns, stamp_ns)
            elif opcode in (SCHEMA, CHANNEL):
                _define(opcode, data[at:after], index)
    except (ValueError, struct.error) as error:
        raise ValueError(f"{error}, in the chunk at byte {offset}") from None
    if counts:
        _add_span(
            index, Span(offset, end - offset, start_ns, end_ns, frozenset(counts), True), counts
        )


def _define(opcode: int, content: bytes, index: McapIndex) -> None:
    if opcode == SCHEMA:
        schema = parse_schema(content)
        index.schemas.setdefault(schema.id, schema)
    else:
        channel = parse_channel(content)
        index.channels.setdefault(channel.id, channel)


def _add_span(index: McapIndex, span: Span, counts: Counter[int]) -> None:
    index.spans.append(span)
    index.counts.update(counts)
    index.start_ns = min(index.start_ns, span.start_ns)
    index.end_ns = max(index.end_ns, span.end_ns)


class _Run:
    """Collects neighbouring messages outside chunks into one span."""

    def __init__(self) -> None:
        self.length = 0

    def add(self, start: int, end: int, channel: int, stamp_ns: int) -> None:
        if self.length == 0:
            self.offset, self.counts = start, Counter[int]()
            self.start_ns = self.end_ns = stamp_ns
        self.length = end - self.offset
        self.counts[channel] += 1
        self.start_ns, self.end_ns = min(self.start_ns, stamp_ns), max(self.end_ns, stamp_ns)

    def close(self, index: McapIndex) -> None:
        if self.length:
            span = Span(
                self.offset, self.length, self.start_ns, self.end_ns, frozenset(self.counts), False
            )
            _add_span(index, span, self.counts)
        self.length = 0


def walk_records(file: BinaryIO, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end) of the contents of the records between two places of a file."""
    at = start
    while at < end:
        file.seek(at)
        head = file.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            raise ValueError(f"the record at byte {at} is cut off")
        opcode, length = RECORD_HEAD.unpack(head)
        after = at + RECORD_HEAD.size + length
        if after > end:
            raise ValueError(f"the record at byte {at} runs past the end of its section")
        yield opcode, at + RECORD_HEAD.size, after
        at = after


def how_far(file: BinaryIO, size: int) -> tuple[int, str]:
    """Return where the whole part of a file without an end ends, and say what is in it."""
    chunks, messages, good, end_ns = 0, 0, len(MAGIC), 0
    try:
        for opcode, at, after in walk_records(file, len(MAGIC), size):
            good = after
            if opcode in (CHUNK, MESSAGE):
                chunks, messages = chunks + (opcode == CHUNK), messages + (opcode == MESSAGE)
                # The last log time of a chunk, or the log time of a message.
                file.seek(at + (8 if opcode == CHUNK else 6))
                end_ns = max(end_ns, int.from_bytes(file.read(8), "little"))
    except ValueError:
        pass  # The first record that is not whole is what we look for.
    text = f"the first {good} of {size} bytes are whole, with {chunks} chunks"
    if messages:
        text += f" and {messages} messages outside chunks"
    if chunks or messages:
        text += f", up to log time {format_seconds(end_ns)}"
    return good, text
