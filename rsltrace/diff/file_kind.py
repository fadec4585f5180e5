"""What a file is, from its first bytes: a trace, or a recording of another kind.

Apart from the readers, so that a diff of two traces loads none of what recordings need.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from mcap.opcode import Opcode

from rsltrace.trace.format import METADATA_FORMAT, begins_a_trace
from rsltrace.trace.mcap.records import MAGIC, DamageError, RecordFields, parse_header
from rsltrace.trace.model.regular_file import not_regular

_HEAD_BYTES = 4096
_SQLITE_MAGIC = b"SQLite format 3\0"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_ROS1_MAGIC = b"#ROSBAG"


def is_trace(path: str | os.PathLike[str]) -> bool:
    """Whether a local file is a trace of rsltrace, by its first records; whole or cut off."""
    head = _head(path)
    if not head.startswith(MAGIC):
        return False
    # The format has it that this metadata is the first record after the header.
    with suppress(DamageError):
        fields = RecordFields(head[len(MAGIC) :])
        fields.take(1)
        header = parse_header(fields.take(fields.u64()))
        if not any(head[len(MAGIC) + fields.position :]):  # zeros are what a crash leaves
            return begins_a_trace(header)
        try:
            opcode, _ = fields.take(1)[0], fields.u64()
            return opcode == Opcode.METADATA and fields.text() == METADATA_FORMAT
        except DamageError:
            return begins_a_trace(header)
    return False


def is_recording(path: str | os.PathLike[str]) -> bool:
    """Whether a local path is a recording that is no trace: a folder, an MCAP or sqlite3 file."""
    if Path(path).is_dir():
        return True
    known = (MAGIC, _SQLITE_MAGIC, _ZSTD_MAGIC, _ROS1_MAGIC)
    return _head(path).startswith(known) and not is_trace(path)


def _head(path: str | os.PathLike[str]) -> bytes:
    try:
        if not_regular(Path(path)):  # opening a named pipe would wait for a writer
            return b""
        with open(path, "rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError:
        return b""
