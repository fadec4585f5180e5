"""Read an MCAP file as a rosbag2 storage: topics, and messages by chunk.

The rosbags and mcap packages read MCAP, too. But order and completeness decide what a simulation
does: rosbags skips chunks that are indexed without their messages, and neither refuses a chunk with
messages outside the times in its index.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode

from rsltrace.errors import BagError
from rsltrace.trace.mcap.chunk import cut_messages, read_chunk
from rsltrace.trace.mcap.reader import (
    McapFooter,
    McapSummary,
    data_crc,
    has_end,
    read_body,
    read_footer,
    read_header,
    read_summary,
    walk_records,
)
from rsltrace.trace.mcap.records import (
    MAGIC,
    MESSAGE,
    RECORD_HEAD,
    DamageError,
    McapChannel,
    RecordSpan,
    TruncatedFile,
    records_in,
)
from rsltrace.trace.mcap.source import ByteSource, FileSource
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.recordings.topic import BagMessage, Extent, StoredTopic, parse_qos

# Messages outside chunks are gathered into runs, and read like chunks.

RUN_BYTES = 1 << 20
"""The size of such a run."""

_CHUNK, _DATA_END, _FOOTER = int(Opcode.CHUNK), int(Opcode.DATA_END), int(Opcode.FOOTER)
_DEFINITIONS = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL)))
_BODY = struct.Struct("<HIQQ")
"""The body of a message up to its data: channel, sequence, log time, publish time."""


@dataclass(frozen=True, slots=True)
class RecordRange:
    """A chunk, or a run of messages outside chunks: whole records.

    ``channels`` are those with messages in it, None if unknown.
    """

    span: RecordSpan
    start_ns: int
    end_ns: int
    channels: frozenset[int] | None
    is_chunk: bool


@dataclass(slots=True)
class McapIndex:
    """Everything known about a file before its messages are read.

    ``definitions`` are its schemas and channels. ``data_size`` and ``data_crc`` cover the bytes
    before the DataEnd record, 0 if unknown.
    """

    profile: str
    definitions: McapSummary = field(default_factory=McapSummary)
    parts: list[RecordRange] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    start_ns: int = 0
    end_ns: int = 0
    data_size: int = 0
    data_crc: int = 0
    cut_off: str = ""
    """How much of a truncated file is whole; empty for a complete one."""

    def add(
        self, span: RecordSpan, times: tuple[int, int], counts: Counter[int], is_chunk: bool
    ) -> None:
        """Add a range with counted messages."""
        self.parts.append(RecordRange(span, *times, frozenset(counts), is_chunk))
        self.counts.update(counts)
        self.start_ns = min(self.start_ns, times[0])
        self.end_ns = max(self.end_ns, times[1])


def scan_file(source: ByteSource, start: int, end: int, index: McapIndex) -> None:
    """Fill ``index`` by walking the file, reading every chunk once. Raises DamageError."""
    index.start_ns, index.end_ns = 2**64 - 1, 0
    scan_records(source, start, end, index, skip_chunks=False)
    if not index.parts:
        index.start_ns = 0


def scan_records(
    source: ByteSource, start: int, end: int, index: McapIndex, *, skip_chunks: bool
) -> bool:
    """Add the records between two offsets of a file to ``index``. Raises DamageError.

    With ``skip_chunks`` no chunk is read; finding one ends the walk with False.
    """
    run = _MessageRun()
    for opcode, span in walk_records(source, start, end):
        if opcode == MESSAGE:
            if span.length < RECORD_HEAD.size + _BODY.size:
                raise DamageError(f"the message at byte {span.offset} is too short")
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


def _scan_chunk(source: ByteSource, span: RecordSpan, index: McapIndex) -> None:
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
    except (DamageError, struct.error) as error:
        raise DamageError(f"{error}, in the chunk at byte {span.offset}") from None
    if counts:
        index.add(span, (start_ns, end_ns), counts, is_chunk=True)


class _MessageRun:
    """Joins neighbouring messages outside chunks into one range."""

    def __init__(self) -> None:
        self.length = 0

    def add(self, span: RecordSpan, channel: int, stamp_ns: int) -> None:
        if self.length == 0:
            self.offset, self.counts = span.offset, Counter[int]()
            self.start_ns = self.end_ns = stamp_ns
        self.length = span.end - self.offset
        self.counts[channel] += 1
        self.start_ns, self.end_ns = min(self.start_ns, stamp_ns), max(self.end_ns, stamp_ns)

    def close(self, index: McapIndex) -> None:
        if self.length:
            span = RecordSpan(self.offset, self.length)
            index.add(span, (self.start_ns, self.end_ns), self.counts, is_chunk=False)
        self.length = 0


def intact_length(source: ByteSource) -> tuple[int, str]:
    """Return the length of the whole part of a truncated file, and what is in it in words."""
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
    except DamageError:
        pass  # The first record that is not whole is what we look for.
    text = f"the first {good} of {source.size} bytes are whole, with {counts[_CHUNK]} chunks"
    if counts[MESSAGE]:
        text += f" and {counts[MESSAGE]} messages outside chunks"
    if counts:
        text += f", up to log time {format_seconds(end_ns)}"
    return good, text


# The index comes from the summary only if that is complete: chunks may be indexed without their
# messages, messages may lie outside chunks, and writers may omit the summary. Gaps between indexed
# chunks are walked, so no message is skipped silently.


def read_index(source: ByteSource, *, recover: bool = False) -> McapIndex:
    """Return the index of an MCAP file.

    Raises DamageError saying what is damaged and where, TruncatedFile when the end is missing; with
    ``recover`` the index then covers what is whole.
    """
    if not has_end(source):
        end, text = intact_length(source)
        if not recover:
            raise TruncatedFile(text)
        profile, data_start = _profile(source)
        index = McapIndex(profile, cut_off=text)
        scan_file(source, data_start, end, index)
        return index
    profile, data_start = _profile(source)
    try:
        footer = read_footer(source)
    except DamageError as error:
        raise DamageError(f"the footer before byte {source.size} is damaged ({error})") from None
    start = footer.summary_start
    index = McapIndex(profile)
    complete = start != 0 and _add_summary(source, footer, data_start, index)
    if not complete:
        index = McapIndex(profile)
        scan_file(source, data_start, start or footer.offset, index)
    # What no chunk's CRC covers: a file that was walked, messages outside chunks.
    unchecked = not complete or not all(part.is_chunk for part in index.parts)
    if unchecked and index.data_crc and index.data_crc != data_crc(source, index.data_size):
        raise DamageError(f"the CRC of the data section (up to byte {index.data_size}) is wrong")
    return index


def _profile(source: ByteSource) -> tuple[str, int]:
    """Return the profile and where the data begins."""
    try:
        header, data_start = read_header(source)
    except DamageError as error:
        raise DamageError(f"there is no header record ({error})") from None
    return header.profile, data_start


def _add_summary(source: ByteSource, footer: McapFooter, data_start: int, index: McapIndex) -> bool:
    """Fill ``index`` from the summary; return whether that is complete."""
    start = footer.summary_start
    try:
        if start < data_start:
            raise DamageError("it would begin in the header")
        summary = read_summary(source, footer)
        if not _is_complete(summary):
            return False
        return _add_ranges(source, summary, data_start, start, index)
    except DamageError as error:
        raise DamageError(f"the summary at byte {start} is damaged ({error})") from None


def _is_complete(summary: McapSummary) -> bool:
    statistics, channels = summary.statistics, summary.channels
    return (
        statistics is not None
        and statistics.chunks == sum(1 for _ in summary.chunks())
        and statistics.counts.keys() <= channels.keys()
        and statistics.messages == sum(statistics.counts.values())
        and all(c.schema_id in summary.schemas for c in channels.values() if c.schema_id)
    )


def _add_ranges(
    source: ByteSource, summary: McapSummary, data_start: int, data_end: int, index: McapIndex
) -> bool:
    """Add the indexed chunks and the messages between them; False if a chunk is not indexed."""
    index.definitions = summary
    at = data_start
    for chunk in sorted(summary.chunks(), key=lambda chunk: chunk.span.offset):
        if chunk.span.offset < at or chunk.span.end > data_end:
            raise DamageError(f"a chunk at byte {chunk.span.offset} lies outside the data")
        if not scan_records(source, at, chunk.span.offset, index, skip_chunks=True):
            return False
        channels = frozenset(chunk.indexes) or None
        index.parts.append(RecordRange(chunk.span, chunk.start_ns, chunk.end_ns, channels, True))
        at = chunk.end
    if at > data_end:
        raise DamageError(f"the index reaches past byte {data_end}, the end of the data")
    complete = scan_records(source, at, data_end, index, skip_chunks=True)
    statistics = summary.statistics
    assert statistics is not None
    # The statistics count the messages outside chunks, too.
    index.counts.clear()
    index.counts.update(statistics.counts)
    index.start_ns, index.end_ns = statistics.start_ns, statistics.end_ns
    return complete


class McapFile:
    """One open ``.mcap`` file. Raises ``BagError`` when it is no ROS 2 recording or damaged."""

    def __init__(self, path: Path, *, recover: bool = False) -> None:
        """Open ``path``; with ``recover``, the whole part of a truncated file."""
        self.path = path
        self._recover = recover
        self.with_publish_time = False
        self._closed = False
        self._source = FileSource(path, BagError)
        try:
            self._index = self._read_index()
            self._parts = {part.span.offset: part for part in self._index.parts}
            channels = self._index.definitions.channels.values()
            self.topics = [self._topic(channel) for channel in channels]
        except BaseException:
            self.close()
            raise
        self.message_count = self._index.counts.total()
        self.start_ns, self.end_ns = self._index.start_ns, self._index.end_ns
        self.cut_off = self._index.cut_off

    def close(self) -> None:
        self._closed = True
        self._source.close()

    def extents(self, wanted: Mapping[int, int], first_ns: int) -> list[Extent]:
        """Return the chunks that may contain wanted messages, in file order."""
        extents = []
        for part in self._index.parts:
            known = part.channels is None or not part.channels.isdisjoint(wanted)
            if known and part.end_ns >= first_ns:
                extents.append(Extent(*part.span, max(part.start_ns, first_ns), part.end_ns))
        return extents

    def read(
        self, extent: Extent, wanted: Mapping[int, int], first_ns: int
    ) -> Iterator[BagMessage]:
        """Yield the wanted messages of a chunk by time, equal times in file order."""
        yield from self._messages(self._parts[extent.offset], wanted, first_ns)

    def count(self, wanted: Mapping[int, int], first_ns: int) -> int:
        count = sum(self._index.counts[channel] for channel in wanted)
        for part in self._index.parts if first_ns > self.start_ns else []:
            if part.start_ns < first_ns:
                messages = self._messages(part, wanted, 0)
                count -= sum(stamp_ns < first_ns for stamp_ns, _, _ in messages)
        return count

    def last_ns(self, wanted: Mapping[int, int], first_ns: int) -> int | None:
        last_ns: int | None = None
        extents = self.extents(wanted, first_ns)
        for extent in sorted(extents, key=lambda extent: extent.end_ns, reverse=True):
            if last_ns is not None and extent.end_ns <= last_ns:
                break
            messages = self._messages(self._parts[extent.offset], wanted, first_ns)
            if messages:
                last_ns = max(messages[-1][0], last_ns or 0)
        return last_ns

    def _messages(
        self, part: RecordRange, wanted: Mapping[int, int], first_ns: int
    ) -> list[BagMessage]:
        if self._closed:
            raise ValueError(f"{self.path} is closed")
        try:
            if part.is_chunk:
                records = read_chunk(self._source, part.span, strict=False)
            else:
                records = self._source.read_at(*part.span)
            messages = cut_messages(
                records, wanted, first_ns, with_publish_time=self.with_publish_time
            )
            # The order of the stream depends on these two times.
            if messages and not (part.start_ns <= messages[0][0] <= messages[-1][0] <= part.end_ns):
                raise DamageError("messages lie outside the times the index promises")
        except DamageError as error:
            raise BagError(
                f"{self.path}: {error}, in the {'chunk' if part.is_chunk else 'messages'} at byte "
                f"{part.span.offset} (log time {format_seconds(part.start_ns)} to "
                f"{format_seconds(part.end_ns)}); repair it with 'mcap recover'"
            ) from None
        return messages

    def _read_index(self) -> McapIndex:
        try:
            index = read_index(self._source, recover=self._recover)
        except TruncatedFile as error:
            raise BagError(
                f"{self.path}: the recording was cut off, its footer and index are missing: "
                f"{error}. Repair it with 'mcap recover {self.path.name} -o repaired.mcap' (and "
                "'ros2 bag reindex' if it belongs to a bag folder)"
            ) from None
        except DamageError as error:
            raise BagError(f"{self.path}: {error}; repair it with 'mcap recover'") from None
        if index.profile not in ("ros2", ""):
            ros1 = index.profile == "ros1"
            advice = "; convert it with 'rosbags-convert'" if ros1 else ""
            raise BagError(
                f"{self.path}: not a ROS 2 recording: its MCAP profile is {index.profile!r}{advice}"
            )
        return index

    def _topic(self, channel: McapChannel) -> StoredTopic:
        schema = self._index.definitions.schemas.get(channel.schema_id)
        try:
            offered = parse_qos(channel.metadata.get("offered_qos_profiles", ""))
        except ValueError as error:
            raise BagError(f"{self.path}: topic {channel.topic}: {error}") from None
        return StoredTopic(
            id=channel.id,
            name=channel.topic,
            type_name=schema.name if schema else "",
            serialization_format=channel.message_encoding,
            offered_qos=offered,
            message_count=self._index.counts[channel.id],
            schema_text=schema.text if schema and schema.text else None,
            schema_encoding=schema.encoding if schema and schema.text else "",
            type_hash=channel.metadata.get("topic_type_hash", ""),
        )
