"""Reading an MCAP file as a rosbag2 storage: topics, and messages by chunk.

The rosbags and mcap packages read MCAP too. This reader exists because order and completeness
decide what a simulation does: rosbags passes over chunks that are indexed without their messages,
and neither refuses a chunk whose messages lie outside the times its index promises.
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
    Footer,
    Summary,
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
    Channel,
    CutOff,
    Damaged,
    Span,
    records_in,
)
from rsltrace.trace.mcap.source import ByteSource, FileSource
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.recordings.merge import Message
from rsltrace.trace.recordings.topic import Extent, StoredTopic, parse_qos

# Walking an MCAP recording record by record, where its summary does not tell what is in it.
#
# Messages outside chunks are gathered into runs, so that they are read like chunks later.

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


# Where the messages of an MCAP recording are: from its summary, or by walking the file.
#
# The summary is taken only if it tells everything: chunks may be indexed without their messages,
# messages may stand outside chunks, and a writer may leave the summary out. What it does not tell
# (the gaps between indexed chunks) is walked, so no message is ever passed over in silence.


def read_index(source: ByteSource, *, recover: bool = False) -> McapIndex:
    """Return the index of an MCAP file.

    Raises Damaged saying what is damaged and at which byte, CutOff when the end is missing (how
    far the file is good); with ``recover`` the index is then that of what is whole.
    """
    if not has_end(source):
        end, text = how_far(source)
        if not recover:
            raise CutOff(text)
        profile, data_start = _profile(source)
        index = McapIndex(profile, cut_off=text)
        scan_file(source, data_start, end, index)
        return index
    profile, data_start = _profile(source)
    try:
        footer = read_footer(source)
    except Damaged as error:
        raise Damaged(f"the footer before byte {source.size} is damaged ({error})") from None
    start = footer.summary_start
    index = McapIndex(profile)
    complete = start != 0 and _take_summary(source, footer, data_start, index)
    if not complete:
        index = McapIndex(profile)
        scan_file(source, data_start, start or footer.offset, index)
    # What no chunk's CRC covers: a file that was walked, messages outside chunks.
    unchecked = not complete or not all(part.is_chunk for part in index.parts)
    if unchecked and index.data_crc and index.data_crc != data_crc(source, index.data_size):
        raise Damaged(f"the CRC of the data section (up to byte {index.data_size}) is wrong")
    return index


def _profile(source: ByteSource) -> tuple[str, int]:
    """Return the profile and where the data begins."""
    try:
        header, data_start = read_header(source)
    except Damaged as error:
        raise Damaged(f"there is no header record ({error})") from None
    return header.profile, data_start


def _take_summary(source: ByteSource, footer: Footer, data_start: int, index: McapIndex) -> bool:
    """Fill ``index`` from the summary; say whether it tells everything."""
    start = footer.summary_start
    try:
        if start < data_start:
            raise Damaged("it would begin in the header")
        summary = read_summary(source, footer)
        if not _tells_everything(summary):
            return False
        return _take_parts(source, summary, data_start, start, index)
    except Damaged as error:
        raise Damaged(f"the summary at byte {start} is damaged ({error})") from None


def _tells_everything(summary: Summary) -> bool:
    statistics, channels = summary.statistics, summary.channels
    return (
        statistics is not None
        and statistics.chunks == sum(1 for _ in summary.chunks())
        and statistics.counts.keys() <= channels.keys()
        and statistics.messages == sum(statistics.counts.values())
        and all(c.schema_id in summary.schemas for c in channels.values() if c.schema_id)
    )


def _take_parts(
    source: ByteSource, summary: Summary, data_start: int, data_end: int, index: McapIndex
) -> bool:
    """Add the indexed chunks and the messages between them; no if there is a chunk the index
    lacks."""
    index.definitions = summary
    at = data_start
    for chunk in sorted(summary.chunks(), key=lambda chunk: chunk.span.offset):
        if chunk.span.offset < at or chunk.span.end > data_end:
            raise Damaged(f"a chunk at byte {chunk.span.offset} lies outside the data")
        if not scan_records(source, at, chunk.span.offset, index, skip_chunks=True):
            return False
        channels = frozenset(channel for channel, _ in chunk.indexes) or None
        index.parts.append(Part(chunk.span, chunk.start_ns, chunk.end_ns, channels, True))
        at = chunk.end
    if at > data_end:
        raise Damaged(f"the index reaches past byte {data_end}, the end of the data")
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
        """Open ``path``; with ``recover``, what is whole of a file that was cut off."""
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
        """Close the file."""
        self._closed = True
        self._source.close()

    def extents(self, wanted: Mapping[int, int], first_ns: int) -> list[Extent]:
        """Return the chunks that may hold wanted messages, in file order."""
        extents = []
        for part in self._index.parts:
            known = part.channels is None or not part.channels.isdisjoint(wanted)
            if known and part.end_ns >= first_ns:
                extents.append(Extent(*part.span, max(part.start_ns, first_ns), part.end_ns))
        return extents

    def read(self, extent: Extent, wanted: Mapping[int, int], first_ns: int) -> Iterator[Message]:
        """Yield the wanted messages of a chunk by time, equal times in file order."""
        yield from self._messages(self._parts[extent.offset], wanted, first_ns)

    def count(self, wanted: Mapping[int, int], first_ns: int) -> int:
        """Return how many wanted messages there are."""
        count = sum(self._index.counts[channel] for channel in wanted)
        for part in self._index.parts if first_ns > self.start_ns else []:
            if part.start_ns < first_ns:
                messages = self._messages(part, wanted, 0)
                count -= sum(stamp_ns < first_ns for stamp_ns, _, _ in messages)
        return count

    def last_ns(self, wanted: Mapping[int, int], first_ns: int) -> int | None:
        """Return the time of the last wanted message."""
        last_ns: int | None = None
        extents = self.extents(wanted, first_ns)
        for extent in sorted(extents, key=lambda extent: extent.end_ns, reverse=True):
            if last_ns is not None and extent.end_ns <= last_ns:
                break
            messages = self._messages(self._parts[extent.offset], wanted, first_ns)
            if messages:
                last_ns = max(messages[-1][0], last_ns or 0)
        return last_ns

    def _messages(self, part: Part, wanted: Mapping[int, int], first_ns: int) -> list[Message]:
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
            # The order of the whole stream rests on these two times.
            if messages and not (part.start_ns <= messages[0][0] <= messages[-1][0] <= part.end_ns):
                raise Damaged("messages lie outside the times the index promises")
        except Damaged as error:
            raise BagError(
                f"{self.path}: {error}, in the {'chunk' if part.is_chunk else 'messages'} at byte "
                f"{part.span.offset} (log time {format_seconds(part.start_ns)} to "
                f"{format_seconds(part.end_ns)}); repair it with 'mcap recover'"
            ) from None
        return messages

    def _read_index(self) -> McapIndex:
        try:
            index = read_index(self._source, recover=self._recover)
        except CutOff as error:
            raise BagError(
                f"{self.path}: the recording was cut off, its footer and index are missing: "
                f"{error}. Repair it with 'mcap recover {self.path.name} -o repaired.mcap' (and "
                "'ros2 bag reindex' if it belongs to a bag folder)"
            ) from None
        except Damaged as error:
            raise BagError(f"{self.path}: {error}; repair it with 'mcap recover'") from None
        if index.profile not in ("ros2", ""):
            ros1 = index.profile == "ros1"
            advice = "; convert it with 'rosbags-convert'" if ros1 else ""
            raise BagError(
                f"{self.path}: not a ROS 2 recording: its MCAP profile is {index.profile!r}{advice}"
            )
        return index

    def _topic(self, channel: Channel) -> StoredTopic:
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
