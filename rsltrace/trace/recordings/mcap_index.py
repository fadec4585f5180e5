"""Where the messages of an MCAP recording are: from its summary, or by walking the file.

The summary is taken only if it tells everything: chunks may be indexed without their messages,
messages may stand outside chunks, and a writer may leave the summary out. What it does not tell
(the gaps between indexed chunks) is walked, so no message is ever passed over in silence.
"""

from __future__ import annotations

from rsltrace.trace.mcap.records import CutOff, Damaged
from rsltrace.trace.mcap.source import ByteSource
from rsltrace.trace.mcap.summary import (
    Footer,
    Summary,
    data_crc,
    has_end,
    read_footer,
    read_header,
    read_summary,
)
from rsltrace.trace.recordings.mcap_scan import McapIndex, Part, how_far, scan_file, scan_records


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
