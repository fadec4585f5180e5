"""Walking a file record by record, where no summary tells what is in it."""

from __future__ import annotations

from collections.abc import Iterator

from mcap.opcode import Opcode

from rsltrace.trace.mcap.records import MAGIC, RECORD_BYTES_MAX, RECORD_HEAD, Damaged, Fields, Span
from rsltrace.trace.mcap.source import ByteSource

_BLOCK_BYTES = 1 << 20
_TORN_BYTES = 64 << 10
_KNOWN = frozenset(map(int, Opcode))


def read_body(source: ByteSource, span: Span, opcode: int) -> bytes:
    """Return the body of the record at ``span``. Raises Damaged if it is not such a record."""
    if not RECORD_HEAD.size <= span.length <= RECORD_BYTES_MAX:
        raise Damaged(f"its length is given as {span.length}")
    record = source.read_at(*span)
    found, length = RECORD_HEAD.unpack_from(record)
    if found != opcode or length + RECORD_HEAD.size != span.length:
        raise Damaged("another record is there")
    return record[RECORD_HEAD.size :]


def walk_records(source: ByteSource, start: int, end: int) -> Iterator[tuple[int, Span]]:
    """Yield opcode and place of the records between two places of a file.

    Raises Damaged at one that is not whole.
    """
    at = start
    while at < end:
        if at + RECORD_HEAD.size > end:
            raise Damaged(f"the record at byte {at} is cut off")
        opcode, length = RECORD_HEAD.unpack(source.read_at(at, RECORD_HEAD.size))
        span = Span(at, length + RECORD_HEAD.size)
        if span.end > end:
            raise Damaged(f"the record at byte {at} runs past the end of its section")
        yield opcode, span
        at = span.end


def whole_records(source: ByteSource) -> Iterator[tuple[int, Span]]:
    """Yield what ``walk_records`` does of a file without an end, as far as it is whole.

    Raises Damaged, telling why, where the rest is not the beginning of one more record: a file
    that was cut ends in the middle of one, or in zeros, which a crash leaves where data should be.
    """
    at = len(MAGIC)
    try:
        for opcode, span in walk_records(source, at, source.size):
            if opcode not in _KNOWN:
                break
            yield opcode, span
            at = span.end
    except Damaged:
        pass  # where it was cut, or is damaged
    if why := _not_torn(source, at):
        raise Damaged(why)


def _not_torn(source: ByteSource, at: int) -> str:
    """Say why what is left of a file is no record that was being written, "" if it is one."""
    rest = source.size - at
    head = source.read_at(at, min(rest, _TORN_BYTES))
    if not any(head):
        return "" if _is_zero(source, at + len(head)) else "there are zeros where a record begins"
    if rest < RECORD_HEAD.size:
        return ""
    opcode, length = RECORD_HEAD.unpack_from(head)
    if opcode not in _KNOWN:
        return f"no record of MCAP begins with {opcode}"
    said = length_by_fields(opcode, head[RECORD_HEAD.size :])
    if said is not None and said != length:
        return f"its length is given as {length}, its fields say {said}"
    return ""


def _is_zero(source: ByteSource, at: int) -> bool:
    for offset in range(at, source.size, _BLOCK_BYTES):
        if any(source.read_at(offset, min(_BLOCK_BYTES, source.size - offset))):
            return False
    return True


_BEFORE_TEXTS = {
    Opcode.HEADER: (0, 2),
    Opcode.SCHEMA: (2, 3),
    Opcode.CHANNEL: (4, 3),
    Opcode.CHUNK: (28, 1),
    Opcode.MESSAGE_INDEX: (2, 1),
    Opcode.ATTACHMENT: (16, 2),
    Opcode.METADATA: (0, 2),
}
"""How many bytes stand before the first text (or map, which has a length, too), and how many of
these follow each other."""


def length_by_fields(opcode: int, body: bytes) -> int | None:
    """Return how long a record's fields say that it is, None where they are cut off, too."""
    if opcode not in _BEFORE_TEXTS:
        return None
    fixed, texts = _BEFORE_TEXTS[Opcode(opcode)]
    fields = Fields(body)
    try:
        fields.take(fixed)
        for number in range(texts):
            length = fields.u32()
            if number + 1 == texts and opcode not in (Opcode.CHUNK, Opcode.ATTACHMENT):
                return fields.position + length
            fields.take(length)
        length = fields.u64()
    except Damaged:
        return None
    return fields.position + length + (4 if opcode == Opcode.ATTACHMENT else 0)
