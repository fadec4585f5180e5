"""Log records, read from their bytes.

They are in sight all the time, and the decoder that goes by schemas takes longer to load than
everything else on a first screen.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from rsltrace.errors import TraceError
from rsltrace.trace.model.event import Output
from rsltrace.trace.reader import Trace

LEVEL_WARN = 30
_TYPE = "rcl_interfaces/msg/Log"
_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}
_HEAD = struct.Struct("<4xiIB")
_LENGTH = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class LogRecord:
    """A log record: level as a number (30: warning), logger name, text, ``module.py:31``."""

    level: int
    name: str
    text: str
    place: str = ""

    @property
    def level_name(self) -> str:
        """``WARN``, or the number of an unusual level."""
        return _LEVELS.get(self.level, str(self.level))


def log_record(trace: Trace, output: Output) -> LogRecord | None:
    """Return the log record of an output of kind LOG; None if it was not kept or is unreadable."""
    try:
        found = trace.payload(output)
        channel = trace.channel_of(output)
        if found is None or channel is None or channel.type != _TYPE:
            return None
        return parse_log(found[2])
    except (TraceError, ValueError):
        return None


def parse_log(data: bytes) -> LogRecord:
    """Read a ``rcl_interfaces/msg/Log`` in CDR. Raises ValueError for anything else."""
    try:
        _, _, level = _HEAD.unpack_from(data)
        name, position = _string(data, _HEAD.size)
        text, position = _string(data, position)
        file, position = _string(data, position)
        _, position = _string(data, position)
        (line,) = _LENGTH.unpack_from(data, position + (-position % 4))
    except (struct.error, IndexError) as error:
        raise ValueError(f"not a log record: {error}") from error
    return LogRecord(level, name, text, f"{file}:{line}" if file else "")


def _string(data: bytes, position: int) -> tuple[str, int]:
    position += -(position - 4) % 4
    (length,) = _LENGTH.unpack_from(data, position)
    end = position + _LENGTH.size + length
    if end > len(data):
        raise IndexError("a string is cut off")
    return data[position + _LENGTH.size : end].rstrip(b"\0").decode("utf-8", "replace"), end
