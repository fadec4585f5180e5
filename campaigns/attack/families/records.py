"""Traces changed as records: every field a lie, with all other offsets and checksums right.

So the lie is met where it is used, and not at the first checksum. A third of the cases leave
checksums or indexes stale instead.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable
from random import Random

import zstandard
from mcap import records
from mcap.opcode import Opcode

from campaigns.attack import hostile, mcap_parts
from campaigns.attack.corpus import Corpus
from campaigns.attack.families.common import Family
from campaigns.attack.families.trace_case import attack_trace
from campaigns.attack.mcap_parts import Part
from campaigns.attack.model import MIB, Case

Change = Callable[[Random, list[Part]], list[Part] | None]
"""Changes the parts of a trace; returns others, or None for the same list."""


def _attack(change: Change, *, differs: bool = False, rehash: bool = False) -> Callable[..., None]:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        data = rng.choice(corpus.traces)
        parts = mcap_parts.take_apart(data)
        parts = change(rng, parts) or parts
        if rehash and rng.random() < 0.7:
            mcap_parts.rehash(parts)
        repair = rng.random() < 0.85
        attack_trace(
            case, rng, mcap_parts.put_together(parts, repair=repair), data, differs=differs
        )

    return attack


def _chosen(rng: Random, parts: list[Part], opcode: int) -> Part | None:
    fitting = [part for part in parts if part.opcode == opcode]
    return rng.choice(fitting) if fitting else None


def _length_lies(rng: Random, parts: list[Part]) -> None:
    part = rng.choice(parts)
    part.length = rng.choice((len(part.body) + rng.choice((-1, 1, 9, -8)), hostile.number(rng)))


def _any_field(rng: Random, parts: list[Part]) -> list[Part] | None:
    """Any number in any record becomes an extreme one, after the repair of all others."""
    mcap_parts.put_together(parts)
    for _ in range(rng.choice((1, 1, 2, 5))):
        opcode = rng.choice(sorted({part.opcode for part in parts if part.opcode != 0x07}))
        part = _chosen(rng, parts, opcode)
        if part is None:
            continue
        try:
            record = part.record
            numbers = [f.name for f in dataclasses.fields(record) if f.type in (int, "int")]
            if numbers:
                setattr(record, rng.choice(numbers), hostile.number(rng, rng.choice((16, 32, 64))))
                part.record = record
        except Exception:  # too large for its field
            body = bytearray(part.body)
            if len(body) >= 8:
                at = rng.randrange(len(body) - 7)
                body[at : at + 8] = struct.pack("<Q", hostile.number(rng))
                part.body = bytes(body)
    return None


def _dropped(rng: Random, parts: list[Part]) -> None:
    for _ in range(rng.choice((1, 1, 3))):
        if len(parts) > 3:
            parts.pop(rng.randrange(len(parts)))


def _doubled(rng: Random, parts: list[Part]) -> None:
    at = rng.randrange(len(parts))
    copy = Part(parts[at].opcode, parts[at].body)
    parts.insert(rng.randrange(len(parts)), copy)


def _swapped(rng: Random, parts: list[Part]) -> None:
    a, b = rng.randrange(len(parts)), rng.randrange(len(parts))
    parts[a], parts[b] = parts[b], parts[a]


def _unknown_opcode(rng: Random, parts: list[Part]) -> None:
    at = rng.randrange(1, len(parts))
    body = rng.randbytes(rng.choice((0, 8, 1000)))
    parts.insert(at, Part(rng.choice((0x00, 0x10, 0x7F, 0x80, 0xFF)), body))


def _without_summary(rng: Random, parts: list[Part]) -> list[Part]:
    end = next(i for i, part in enumerate(parts) if part.opcode == Opcode.DATA_END)
    footer = Part(Opcode.FOOTER, struct.pack("<QQI", 0, 0, 0))
    kept = parts[: end + 1]
    if rng.random() < 0.5:  # the attachments and results, too
        kept = [p for p in kept if p.opcode not in (Opcode.ATTACHMENT,)]
    return [*kept, footer]


def _two_summaries(rng: Random, parts: list[Part]) -> list[Part]:
    end = next(i for i, part in enumerate(parts) if part.opcode == Opcode.DATA_END)
    again = [Part(part.opcode, part.body) for part in parts[end:]]
    return [*parts, *again] if rng.random() < 0.5 else [*parts[:-1], *again]


def _chunk_lies(rng: Random, parts: list[Part]) -> None:
    part = _chosen(rng, parts, Opcode.CHUNK)
    assert part is not None
    chunk = part.record
    assert isinstance(chunk, records.Chunk)
    lie = rng.randrange(6)
    if lie == 0:
        chunk.uncompressed_size = hostile.number(rng)
    elif lie == 1:
        chunk.uncompressed_crc = rng.choice((0, 1, 2**32 - 1))
    elif lie == 2:
        chunk.compression = rng.choice(("", "lz4", "zstd", "xz", "\x1b[31m", "none", "ZSTD"))
    elif lie == 3:
        chunk.data = chunk.data[: rng.randrange(len(chunk.data))]
    elif lie == 4:
        chunk.data = rng.randbytes(rng.choice((0, 1, 100)))
    else:
        chunk.message_start_time, chunk.message_end_time = hostile.number(rng), hostile.number(rng)
    part.record = chunk


def _bomb(rng: Random, parts: list[Part]) -> None:
    """A few kilobytes that unpack to a gigabyte, declared as what they are or as little."""
    part = _chosen(rng, parts, Opcode.CHUNK)
    assert part is not None
    chunk = part.record
    assert isinstance(chunk, records.Chunk)
    size = rng.choice((64, 256, 1024)) * MIB
    maker = zstandard.ZstdCompressor(level=1).compressobj()
    piece = bytes(16 * MIB)
    packed = [maker.compress(piece) for _ in range(size // len(piece))]
    chunk.compression = "zstd"
    chunk.data = b"".join((*packed, maker.flush()))
    chunk.uncompressed_size = rng.choice((size, 1000, 2**40))
    chunk.uncompressed_crc = 0
    part.record = chunk


def _inner_records(rng: Random, parts: list[Part]) -> None:
    """What is in a chunk: lengths, channels, records that must not be there."""
    part = _chosen(rng, parts, Opcode.CHUNK)
    assert part is not None
    rows = list(mcap_parts.inner(mcap_parts.chunk_data(part)))
    for _ in range(rng.choice((1, 1, 4))):
        at = rng.randrange(len(rows)) if rows else 0
        action = rng.randrange(6)
        if not rows:
            break
        opcode, body = rows[at]
        if action == 0:
            rows.pop(at)
        elif action == 1:
            rows.insert(rng.randrange(len(rows)), (opcode, body))
        elif action == 2:
            rows[at] = (opcode, body[: rng.randrange(len(body) + 1)])
        elif action == 3:
            rows[at] = (opcode, struct.pack("<H", hostile.number(rng, 16)) + body[2:])
        elif action == 4:
            rows[at] = (rng.choice((0x06, 0x03, 0x04, 0x02, 0x0C, 0x80)), body)
        else:
            other = rng.randrange(len(rows))
            rows[at], rows[other] = rows[other], rows[at]
    mcap_parts.set_chunk_data(part, mcap_parts.joined(rows))


def _inner_length(rng: Random, parts: list[Part]) -> None:
    part = _chosen(rng, parts, Opcode.CHUNK)
    assert part is not None
    data = bytearray(mcap_parts.chunk_data(part))
    struct.pack_into("<Q", data, 1, hostile.number(rng))
    mcap_parts.set_chunk_data(part, bytes(data), rng.choice((None, "", "lz4")))


def _recompressed(rng: Random, parts: list[Part]) -> None:
    """Nothing changes but the compression: the same run, whatever it takes to read it."""
    for part in parts:
        if part.opcode == Opcode.CHUNK:
            mcap_parts.set_chunk_data(part, mcap_parts.chunk_data(part), rng.choice(("", "lz4")))


def _field_of(topic: str, fields: dict[str, tuple[int, str]]) -> Change:
    def change(rng: Random, parts: list[Part]) -> None:
        name = rng.choice(list(fields))
        at, form = fields[name]
        size = struct.calcsize(form)
        chance = rng.choice((0.01, 0.1, 1.0))
        value = hostile.number(rng, 8 * size)

        def one(data: bytes, nth: int) -> bytes:
            if rng.random() > chance or len(data) < 4 + at + size:
                return data
            return data[: 4 + at] + struct.pack(form, value) + data[4 + at + size :]

        mcap_parts.change_messages(parts, topic, one)

    return change


_event_field = _field_of(
    "/rsltrace/events",
    {
        "index": (8, "<Q"),
        "stamp": (16, "<Q"),
        "cause_event": (24, "<Q"),
        "input_hash": (32, "<Q"),
        "state_hash": (48, "<Q"),
        "entity": (56, "<I"),
        "cause_output": (60, "<I"),
        "outputs": (64, "<I"),
        "kind": (68, "<B"),
        "flags": (69, "<B"),
    },
)
_output_field = _field_of(
    "/rsltrace/outputs",
    {
        "event": (0, "<Q"),
        "hash": (8, "<Q"),
        "entity": (16, "<I"),
        "kind": (20, "<I"),
        "sequence": (24, "<I"),
    },
)
_entity_field = _field_of(
    "/rsltrace/entities",
    {"id": (0, "<I"), "node": (4, "<I"), "kind": (8, "<B"), "length": (12, "<I")},
)
_detail_field = _field_of("/rsltrace/findings", {"event": (0, "<Q"), "entity": (8, "<I")})


def _payload(rng: Random, parts: list[Part]) -> None:
    """A message changes, its checksums are right: what hashes are for."""
    topics = [t for t in mcap_parts.channel_ids(parts) if not t.startswith("/rsltrace/")]
    topic = rng.choice(topics)

    def one(data: bytes, nth: int) -> bytes:
        if len(data) < 6 or (nth and rng.random() < 0.5):
            return data
        at = rng.randrange(4, len(data))
        return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]

    mcap_parts.change_messages(parts, topic, one)


def _payload_shape(rng: Random, parts: list[Part]) -> None:
    """Messages too short, too long, empty, with lengths of strings that lie."""
    topic = rng.choice(list(mcap_parts.channel_ids(parts)))
    action = rng.randrange(5)

    def one(data: bytes, nth: int) -> bytes:
        if rng.random() < 0.3:
            return data
        if action == 0:
            return data[: rng.randrange(len(data) + 1)]
        if action == 1:
            return data + rng.randbytes(rng.randrange(1, 50))
        if action == 2:
            return b""
        if action == 3 and len(data) >= 8:
            return data[:4] + struct.pack("<I", hostile.number(rng, 32)) + data[8:]
        return bytes([rng.randrange(256) for _ in range(4)]) + data[4:]

    mcap_parts.change_messages(parts, topic, one)


def _segments(rng: Random, parts: list[Part]) -> None:
    """The table that finds the events: gaps, overlaps, circles, rows too many and too few."""
    mcap_parts.put_together(parts)
    for part in parts:
        found = mcap_parts.segments_in(part) if part.opcode == Opcode.ATTACHMENT else None
        if found is None:
            continue
        rows = [list(row) for row in found]
        for _ in range(rng.choice((1, 1, 3))):
            action = rng.randrange(6)
            if not rows:
                break
            row = rng.choice(rows)
            if action <= 2:
                at = rng.randrange(11)
                row[at] = rng.choice((hostile.number(rng), row[at] + 1, max(row[at] - 1, 0)))
            elif action == 3:
                rows.insert(rng.randrange(len(rows) + 1), list(row))
            elif action == 4:
                rows.remove(row)
            else:
                rng.shuffle(rows)
        part.was = -1
        record = part.record
        assert isinstance(record, records.Attachment)
        packed = [mcap_parts.SEGMENT_ROW.pack(*(v % 2**64 for v in row)) for row in rows]
        record.data = b"".join(packed) + bytes(rng.choice((0, 0, 0, 1, 87)))
        part.record = record


def _metadata(rng: Random, parts: list[Part]) -> None:
    """Result, format, job: numbers that are none, keys missing, twice the same name."""
    fitting = [part for part in parts if part.opcode == Opcode.METADATA]
    part = rng.choice(fitting)
    record = part.record
    assert isinstance(record, records.Metadata)
    values = ("", "-1", "x", "1e999", "9" * 5000, "١", "0x10", "null", "[" * 100_000, "NaN", "\0")
    action = rng.randrange(5)
    if action == 0 and record.metadata:
        record.metadata.pop(rng.choice(list(record.metadata)))
    elif action == 1:
        copy = Part(part.opcode, part.body)
        parts.insert(parts.index(part) + rng.randrange(2), copy)
    elif action == 2:
        record.name = rng.choice(("rsltrace:format", "rsltrace:result", "rsltrace:job", "rosbag2"))
    elif record.metadata:
        record.metadata[rng.choice(list(record.metadata))] = rng.choice(values)
    part.record = record


def _attachments(rng: Random, parts: list[Part]) -> None:
    part = _chosen(rng, parts, Opcode.ATTACHMENT)
    if part is None:
        return
    record = part.record
    assert isinstance(record, records.Attachment)
    action = rng.randrange(4)
    if action == 0:
        record.name = rng.choice(("rsltrace/segments", "rsltrace/choices", "job.yaml", "../x"))
    elif action == 1:
        record.data = rng.randbytes(rng.choice((0, 1, 88, 10_000)))
    elif action == 2:
        record.data = bytes(4 * MIB)
    else:
        parts.insert(parts.index(part), Part(part.opcode, part.body))
    part.record = record


def _channels(rng: Random, parts: list[Part]) -> None:
    part = _chosen(rng, parts, Opcode.CHANNEL)
    assert part is not None
    record = part.record
    assert isinstance(record, records.Channel)
    action = rng.randrange(6)
    if action == 0:
        record.id = hostile.number(rng, 16)
    elif action == 1:
        record.schema_id = rng.choice((0, 1, 2, hostile.number(rng, 16)))
    elif action == 2:
        record.message_encoding = rng.choice(("", "json", "ros1", "cdr\0"))
    elif action == 3:
        record.topic = rng.choice(
            ("/rsltrace/events", "/rsltrace/outputs", "/rosout", "/ticks", "")
        )
    elif action == 4:
        bomb = "a0: &a0 [x,x]\n" + "".join(
            f"a{i}: &a{i} [*a{i - 1},*a{i - 1},*a{i - 1},*a{i - 1},*a{i - 1},*a{i - 1}]\n"
            for i in range(1, 12)
        )
        record.metadata["offered_qos_profiles"] = rng.choice(
            (bomb, "[" * 50_000, "- !!python/x", "-")
        )
    else:
        parts.insert(parts.index(part), Part(part.opcode, part.body))
    part.record = record


FAMILY = Family(
    "records",
    {
        "length-lies": _attack(_length_lies),
        "any-field": _attack(_any_field),
        "dropped": _attack(_dropped),
        "doubled": _attack(_doubled),
        "swapped": _attack(_swapped),
        "unknown-opcode": _attack(_unknown_opcode),
        "without-summary": _attack(_without_summary),
        "two-summaries": _attack(_two_summaries),
        "chunk-lies": _attack(_chunk_lies),
        "bomb": _attack(_bomb),
        "inner-records": _attack(_inner_records),
        "inner-length": _attack(_inner_length),
        "recompressed": _attack(_recompressed),
        "event-field": _attack(_event_field),
        "event-field-rehashed": _attack(_event_field, rehash=True),
        "output-field": _attack(_output_field),
        "output-field-rehashed": _attack(_output_field, rehash=True),
        "entity-field": _attack(_entity_field, rehash=True),
        "finding-field": _attack(_detail_field),
        "payload": _attack(_payload),
        "payload-shape": _attack(_payload_shape),
        "segments": _attack(_segments),
        "metadata": _attack(_metadata),
        "attachments": _attack(_attachments),
        "channels": _attack(_channels),
    },
)
