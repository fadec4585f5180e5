"""What is where in a trace file, and how the summary at its end tells.

An interrupted trace has no summary; ``scan`` makes the same index by walking the file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceFormatError
from rsltrace.trace.format import (
    ATTACHMENT_INDEX,
    CHECKSUMS_KEY,
    FORMAT_VERSION,
    METADATA_FORMAT,
    SEGMENT_DTYPE,
)
from rsltrace.trace.mcap import summary as mcap_summary
from rsltrace.trace.mcap.records import MAGIC, ChunkIndex, CutOff, Damaged, Header, Schema, Span
from rsltrace.trace.mcap.source import ByteSource
from rsltrace.trace.mcap.summary import Summary
from rsltrace.trace.pieces import damaged, read_attachment, read_metadata

MESSAGE_INDEX_FIXED = 15
"""Bytes of a message index around its entries: head of the record, channel, length."""
_INDEX_ENTRY_BYTES = 16
_NO_SCHEMA = Schema(0, "", "", "")


@dataclass(frozen=True, slots=True)
class ChannelInfo:
    """A channel: a topic with its type and the ros2msg text of its schema."""

    id: int
    topic: str
    type: str
    schema_encoding: str
    schema_text: str
    metadata: Mapping[str, str]


class ChunkEntry(NamedTuple):
    """A chunk: where it is, how many messages of each channel it holds, where their indexes are.

    A channel without an index (the file was cut off behind the chunk), or with one that has no
    entries (events and outputs), is found by walking; its count is then 0.
    """

    span: Span
    counts: Mapping[int, int]
    indexes: Mapping[int, Span]


@dataclass(slots=True)
class TraceIndex:
    """Everything needed to find things in a trace. ``segments`` is SEGMENT_DTYPE, shape (n,).

    ``checksums``: its own metadata have some. ``summary_start`` is where the data section is over
    (0: nobody knows). ``chunks_with`` returns,
    in file order, the chunks that hold messages of some channels: a long run has thousands, which
    only payloads need and opening does not. It may raise Damaged.
    """

    complete: bool
    header: Header
    channels: dict[int, ChannelInfo] = field(default_factory=dict)
    message_counts: dict[int, int] = field(default_factory=dict)
    metadata: dict[str, Span] = field(default_factory=dict)
    attachments: dict[str, Span] = field(default_factory=dict)
    checksums: bool = False
    summary_start: int = 0
    segments: npt.NDArray[np.void] = field(default_factory=lambda: np.zeros(0, SEGMENT_DTYPE))
    chunks_with: Callable[[frozenset[int]], list[ChunkEntry]] = lambda channels: []

    def take(self, summary: Summary) -> None:
        """Take over what the records of the file say of it."""
        self.metadata, self.attachments = summary.metadata, summary.attachments
        for channel_id, schema_id, topic, _, metadata in summary.channels.values():
            _, name, encoding, text = summary.schemas.get(schema_id, _NO_SCHEMA)
            self.channels[channel_id] = ChannelInfo(
                channel_id, topic, name, encoding, text, metadata
            )
        if summary.statistics is not None:
            self.message_counts = summary.statistics.counts


def read_header(source: ByteSource) -> tuple[Header, int]:
    """Return the header and the offset behind it. Raises TraceFormatError if it is not MCAP."""
    head = source.read_at(0, min(source.size, len(MAGIC)))
    if not head:
        raise TraceFormatError(
            f"{source.name} is empty: the run that should have written it ended before it began"
        )
    if not MAGIC.startswith(head):
        what = "an SQLite file, maybe a rosbag2 recording" if head[:6] == b"SQLite" else "not MCAP"
        raise TraceFormatError(
            f"{source.name} is not a trace (it is {what}); a trace is what `rsltrace record` writes"
        )
    try:
        return mcap_summary.read_header(source)
    except CutOff as error:
        raise TraceFormatError(
            f"{source.name} ends in its first record: nothing can be read of it"
        ) from error
    except Damaged as error:
        raise damaged(source, len(MAGIC), "the header", error) from error


def read_summary(source: ByteSource) -> TraceIndex:
    """Return the index of a finished trace. Raises TraceError if it is damaged or no trace."""
    header, _ = read_header(source)
    index = TraceIndex(complete=True, header=header)
    try:
        footer = mcap_summary.read_footer(source)
    except Damaged as error:
        raise damaged(source, source.size, "the footer before the end", error) from error
    # Other writers may leave out the summary, or its CRC.
    if not footer.summary_start or not footer.crc:
        raise not_a_trace(source, index)
    index.summary_start = footer.summary_start
    try:
        summary = mcap_summary.read_summary(source, footer)
    except Damaged as error:
        raise damaged(source, footer.summary_start, "the summary", error) from error
    index.take(summary)
    index.chunks_with = lambda channels: [_chunk_entry(c) for c in summary.chunks(channels)]
    check_version(source, index)
    if ATTACHMENT_INDEX not in index.attachments:
        raise TraceFormatError(f"{source.name} is incomplete: {ATTACHMENT_INDEX} is missing in it")
    index.segments = _read_segments(source, index.attachments[ATTACHMENT_INDEX])
    return index


def _chunk_entry(chunk: ChunkIndex) -> ChunkEntry:
    # Each index reaches to the next one: that gives its length, and so the number of messages.
    starts = sorted((at, channel_id) for channel_id, at in chunk.indexes)
    indexes: dict[int, Span] = {}
    counts: dict[int, int] = {}
    for position, (at, channel_id) in enumerate(starts):
        end = starts[position + 1][0] if position + 1 < len(starts) else chunk.end
        indexes[channel_id] = Span(at, end - at)
        counts[channel_id] = (end - at - MESSAGE_INDEX_FIXED) // _INDEX_ENTRY_BYTES
    return ChunkEntry(chunk.span, counts, indexes)


def check_version(source: ByteSource, index: TraceIndex) -> None:
    """Raise TraceFormatError unless this is a trace of the format version that is read here."""
    if METADATA_FORMAT not in index.metadata:
        raise not_a_trace(source, index)
    found = read_metadata(source, index.metadata[METADATA_FORMAT])
    version = found.get("version", "")
    index.checksums = CHECKSUMS_KEY in found
    if version != str(FORMAT_VERSION):
        raise TraceFormatError(
            f"{source.name} has trace format {version or 'unknown'}, this rsltrace reads "
            f"{FORMAT_VERSION}; it was written by {index.header.library}, which can read it"
        )


def not_a_trace(source: ByteSource, index: TraceIndex) -> TraceFormatError:
    """Return the error for an MCAP file that somebody else wrote."""
    profile, library = index.header
    writer = f"written by {library!r}" if library else "of an unknown writer"
    hint = "; to use it as input, name it under bags: in a job" if profile == "ros2" else ""
    return TraceFormatError(
        f"{source.name} is a plain MCAP recording ({writer}), not a trace of rsltrace{hint}"
    )


def _read_segments(source: ByteSource, span: Span) -> npt.NDArray[np.void]:
    data = read_attachment(source, span)
    if len(data) % SEGMENT_DTYPE.itemsize:
        raise damaged(source, span.offset, ATTACHMENT_INDEX, "its length is not a multiple")
    segments = np.frombuffer(data, dtype=SEGMENT_DTYPE)
    size = np.uint64(source.size)
    sound = all(
        (
            np.array_equal(segments["first_event"], _starts(segments["events"])),
            np.array_equal(segments["first_output"], _starts(segments["outputs"])),
            bool((segments["events"] > 0).all()),
            bool((segments["events_offset"] <= size).all()),
            bool((segments["events_length"] <= size).all()),
            bool((segments["outputs_offset"] <= size).all()),
            bool((segments["outputs_length"] <= size).all()),
        )
    )
    if not sound:
        raise damaged(source, span.offset, ATTACHMENT_INDEX, "its rows contradict each other")
    return segments


def _starts(counts: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Return where each count begins when they follow each other from 0."""
    return np.cumsum(counts, dtype=np.uint64) - counts
