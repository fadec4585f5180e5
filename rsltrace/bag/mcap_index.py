"""Where the messages of an MCAP file are: from its summary, or by walking the file without one.

The summary is taken only if it tells everything: chunks may be indexed without their messages,
messages may stand outside chunks, and a writer may leave the summary out. What it does not tell
(the gaps between indexed chunks) is walked, so no message is ever passed over in silence.
"""

from __future__ import annotations

import struct
import zlib
from typing import BinaryIO

from rsltrace.bag.mcap_chunk import iterate_records
from rsltrace.bag.mcap_records import (
    CHANNEL,
    CHUNK_INDEX,
    FOOTER,
    FOOTER_BYTES,
    HEADER,
    MAGIC,
    RECORD_HEAD,
    SCHEMA,
    STATISTICS,
    ChunkIndex,
    Fields,
    Statistics,
    parse_channel,
    parse_chunk_index,
    parse_schema,
    parse_statistics,
)
from rsltrace.bag.mcap_scan import McapIndex, Span, how_far, scan_file, scan_records, walk_records


class CutOffError(ValueError):
    """The file has no footer. ``str`` says how far it is good."""


def read_index(file: BinaryIO, size: int, *, recover: bool = False) -> McapIndex:
    """Return the index of an MCAP file of ``size`` bytes.

    Raises ``ValueError`` saying what is damaged and at which byte, ``CutOffError`` when the end is
    missing; with ``recover`` the index is then that of what is whole.
    """
    footer_at = size - FOOTER_BYTES
    file.seek(max(0, footer_at))
    footer = file.read(FOOTER_BYTES)
    if footer_at < len(MAGIC) or not footer.endswith(MAGIC):
        end, text = how_far(file, size)
        if not recover:
            raise CutOffError(text)
        profile, data_start = _header(file, end)
        index = McapIndex(profile, cut_off=text)
        scan_file(file, data_start, end, index)
        return index
    profile, data_start = _header(file, footer_at)
    index = McapIndex(profile)
    opcode, length = RECORD_HEAD.unpack_from(footer)
    if (opcode, length) != (FOOTER, 20):
        raise ValueError(f"the footer at byte {footer_at} is damaged")
    summary_at, _, crc = struct.unpack_from("<QQI", footer, RECORD_HEAD.size)
    if summary_at == 0:
        scan_file(file, data_start, footer_at, index)
        _check_data_crc(file, index)
        return index
    if not data_start <= summary_at <= footer_at:
        raise ValueError(f"the footer at byte {footer_at} is damaged")
    file.seek(summary_at)
    summary = file.read(footer_at - summary_at)
    if crc and zlib.crc32(footer[: RECORD_HEAD.size + 16], zlib.crc32(summary)) != crc:
        raise ValueError(f"the CRC of the summary at byte {summary_at} does not match")
    try:
        complete = _take_summary(file, summary, data_start, summary_at, index)
    except (ValueError, struct.error) as error:
        raise ValueError(f"the summary at byte {summary_at} is damaged ({error})") from None
    if not complete:
        index = McapIndex(profile)
        scan_file(file, data_start, summary_at, index)
    if not complete or not all(span.is_chunk for span in index.spans):
        _check_data_crc(file, index)
    return index


def _check_data_crc(file: BinaryIO, index: McapIndex) -> None:
    """Check what no chunk's CRC covers: a file that was walked, messages outside chunks."""
    if index.data_crc == 0:
        return
    file.seek(0)
    crc, rest = 0, index.data_size
    while rest:
        block = file.read(min(rest, 1 << 20))
        if not block:
            raise ValueError("the data section is cut off")
        crc, rest = zlib.crc32(block, crc), rest - len(block)
    if crc != index.data_crc:
        raise ValueError(f"the CRC of the data section (up to byte {index.data_size}) is wrong")


def _header(file: BinaryIO, end: int) -> tuple[str, int]:
    """Return the profile and where the data begins."""
    for opcode, start, after in walk_records(file, len(MAGIC), end):
        if opcode != HEADER:
            break
        file.seek(start)
        return Fields(file.read(after - start)).text(), after
    raise ValueError(f"there is no header record at byte {len(MAGIC)}")


def _take_summary(
    file: BinaryIO, summary: bytes, data_start: int, data_end: int, index: McapIndex
) -> bool:
    """Fill ``index`` from the summary; say whether it tells everything."""
    chunks: list[ChunkIndex] = []
    statistics: Statistics | None = None
    for opcode, start, end in iterate_records(summary):
        content = summary[start:end]
        if opcode == SCHEMA:
            schema = parse_schema(content)
            index.schemas[schema.id] = schema
        elif opcode == CHANNEL:
            channel = parse_channel(content)
            index.channels[channel.id] = channel
        elif opcode == CHUNK_INDEX:
            chunks.append(parse_chunk_index(content))
        elif opcode == STATISTICS:
            statistics = parse_statistics(content)
    if statistics is None or statistics.chunks != len(chunks):
        return False
    if not statistics.counts.keys() <= index.channels.keys():
        return False
    if statistics.messages != sum(statistics.counts.values()):
        return False
    if any(c.schema_id not in index.schemas for c in index.channels.values() if c.schema_id):
        return False
    index.counts.update(statistics.counts)
    index.start_ns, index.end_ns = statistics.start_ns, statistics.end_ns

    at = data_start
    for chunk in sorted(chunks, key=lambda chunk: chunk.offset):
        if chunk.offset < at or chunk.offset + chunk.length > data_end:
            raise ValueError(f"a chunk at byte {chunk.offset} lies outside the data")
        if not _take_gap(file, at, chunk.offset, index):
            return False
        channels = chunk.channels or None
        index.spans.append(
            Span(chunk.offset, chunk.length, chunk.start_ns, chunk.end_ns, channels, True)
        )
        at = chunk.offset + chunk.length + chunk.index_length
    return _take_gap(file, at, data_end, index)


def _take_gap(file: BinaryIO, start: int, end: int, index: McapIndex) -> bool:
    """Find messages between indexed chunks; say no when there is a chunk the index lacks."""
    if start >= end:
        if start > end:
            raise ValueError(f"the index reaches past byte {end}, the end of the data")
        return True
    counts = index.counts.copy()
    complete = scan_records(file, start, end, index, skip_chunks=True)
    # The statistics count these messages already.
    index.counts = counts
    return complete
