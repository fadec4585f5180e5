"""An independent reading of a trace: every message, by the ``mcap`` package alone.

Two files with the same reading say the same of their runs. It is what ``diff`` is held against when
it says "identical", and ``cat`` when it ends well. What is for people alone and has no part in the
identity of a run (``docs/trace-format.md``: texts of details, findings, states, the places of log
calls, the details of entities) is left out, as are job and versions.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import xxhash
from mcap.records import Channel, DataEnd, Message, Schema
from mcap.stream_reader import StreamReader

_EVENT = struct.Struct("<QQQQQQQIIIBB")
_FOR_PEOPLE = frozenset(
    ("/rsltrace/details", "/rsltrace/findings", "/rsltrace/states", "/rsltrace/code_lines")
)


def content(path: Path) -> bytes:
    """Return what a trace says as JSON: ``events`` as rows, and a hash of ``everything``.

    Raises whatever the mcap package raises of a file that it cannot read.
    """
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, int]] = {}
    events: list[list[object]] = []
    by_topic: dict[tuple[str, int], xxhash.xxh3_64] = {}
    with path.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, DataEnd):
                break
            elif isinstance(record, Channel):
                channels[record.id] = (record.topic, record.schema_id)  # its schema may follow
            elif isinstance(record, Message):
                key = channels[record.channel_id]
                if key[0] in _FOR_PEOPLE:
                    continue
                told = _told(key[0], record.data)
                one = by_topic.setdefault(key, xxhash.xxh3_64())
                one.update(struct.pack("<QI", record.log_time, len(told)) + told)
                if key[0] == "/rsltrace/events":
                    row = _EVENT.unpack_from(record.data, 4)
                    events.append([row[1], row[2], row[7], f"{row[4]:016x}", f"{row[5]:016x}"])
    topics = sorted(
        (topic, schemas.get(schema, ""), one.hexdigest())
        for (topic, schema), one in by_topic.items()
    )
    return json.dumps({"events": events, "messages": topics}).encode()


def _told(topic: str, data: bytes) -> bytes:
    """Return the part of a message that belongs to the identity of a run."""
    if topic in ("/rsltrace/entities", "/rosout"):
        return data[:13] + b"\0".join(_strings(data, 13, 2))
    return data


def _strings(data: bytes, at: int, count: int) -> list[bytes]:
    found = []
    for _ in range(count):
        at += -(at - 4) % 4
        (length,) = struct.unpack_from("<I", data, at)
        found.append(data[at + 4 : at + 4 + length])
        at += 4 + length
    return found
