"""What a file is, from its first bytes: a trace, or a recording of another kind.

Apart from the readers, so that a diff of two traces loads none of what recordings need.
"""

from __future__ import annotations

import os
import struct
from contextlib import suppress
from pathlib import Path

from rsltrace.trace.format import MCAP_MAGIC, METADATA_FORMAT

_HEAD_BYTES = 4096
_SQLITE_MAGIC = b"SQLite format 3\0"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_ROS1_MAGIC = b"#ROSBAG"
_RECORD_HEAD = struct.Struct("<BQ")
_METADATA_HEAD = struct.Struct("<BQI")
_METADATA = 0x0C


def is_trace(path: str | os.PathLike[str]) -> bool:
    """Whether a local file is a trace of rsltrace, by its first records; whole or cut off."""
    head = _head(path)
    if not head.startswith(MCAP_MAGIC):
        return False
    # The format has it that this metadata is the first record after the header.
    name = METADATA_FORMAT.encode()
    with suppress(struct.error, OverflowError):  # a damaged length may be any 64 bits
        _, header_length = _RECORD_HEAD.unpack_from(head, len(MCAP_MAGIC))
        place = len(MCAP_MAGIC) + _RECORD_HEAD.size + header_length
        opcode, _, length = _METADATA_HEAD.unpack_from(head, place)
        place += _METADATA_HEAD.size
        return bool(opcode == _METADATA and head[place : place + length] == name)
    return False


def is_recording(path: str | os.PathLike[str]) -> bool:
    """Whether a local path is a recording that is no trace: a folder, an MCAP or sqlite3 file."""
    if Path(path).is_dir():
        return True
    known = (MCAP_MAGIC, _SQLITE_MAGIC, _ZSTD_MAGIC, _ROS1_MAGIC)
    return _head(path).startswith(known) and not is_trace(path)


def _head(path: str | os.PathLike[str]) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError:
        return b""
