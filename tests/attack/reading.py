"""An independent reading of a trace: every message, by the ``mcap`` package alone.

Two files with the same reading say the same of their runs. It is what ``diff`` is held against when
it says "identical", and ``cat`` when it ends well. Texts about the making of a run (job, versions)
are not in it: runs may be identical although their jobs are written differently.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import xxhash
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

_EVENT = struct.Struct("<QQQQQQQIIIBB")
def content(path: Path) -> bytes:
    """Return what a trace says as JSON: ``events`` as rows, and a hash of ``everything``.

    Raises whatever the mcap package raises of a file that it cannot read.
    """
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    events: list[list[object]] = []
    by_topic: dict[tuple[str, str], xxhash.xxh3_64] = {}
    with path.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                channels[record.id] = (record.topic, schemas.get(record.schema_id, ""))
            elif isinstance(record, Message):
                key = channels[record.channel_id]
                one = by_topic.setdefault(key, xxhash.xxh3_64())
                one.update(struct.pack("<QI", record.log_time, len(record.data)))
                one.update(record.data)
                if key[0] == "/rsltrace/events":
                    row = _EVENT.unpack_from(record.data, 4)
                    events.append([row[1], row[2], row[7], f"{row[4]:016x}", f"{row[5]:016x}"])
    topics = sorted((*key, one.hexdigest()) for key, one in by_topic.items())
    return json.dumps({"events": events, "messages": topics}).encode()
