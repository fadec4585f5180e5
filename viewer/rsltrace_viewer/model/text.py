"""Short texts of events and their outputs: what a row of the timeline says.

Log records are read from their bytes here rather than through the schema decoder: they are in
sight all the time, and loading that decoder takes longer than everything else on the first screen.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from rsltrace.errors import TraceError
from rsltrace.model.draw import draw_text
from rsltrace.model.event import Output, OutputKind
from rsltrace.model.printable import printable, shortened
from rsltrace_viewer.model.run import Run

LOG_TYPE = "rcl_interfaces/msg/Log"
LOG_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}
LEVEL_WARN = 30
_LOG_HEAD = struct.Struct("<4xiIB")
_LENGTH = struct.Struct("<I")
_SUMMARY_MAX = 400


@dataclass(frozen=True, slots=True)
class LogRecord:
    """A log record: level as a number (30: warning), logger name and text."""

    level: int
    name: str
    text: str

    @property
    def level_name(self) -> str:
        """``WARN``, or the number of an unusual level."""
        return LOG_LEVELS.get(self.level, str(self.level))


def parse_log(data: bytes) -> LogRecord:
    """Read a ``rcl_interfaces/msg/Log`` in CDR. Raises ValueError for anything else."""
    try:
        _, _, level = _LOG_HEAD.unpack_from(data)
        name, position = _string(data, _LOG_HEAD.size)
        text, _ = _string(data, position)
    except (struct.error, IndexError) as error:
        raise ValueError(f"not a log record: {error}") from error
    return LogRecord(level, name, text)


def _string(data: bytes, position: int) -> tuple[str, int]:
    position += -(position - 4) % 4
    (length,) = _LENGTH.unpack_from(data, position)
    end = position + _LENGTH.size + length
    if end > len(data):
        raise IndexError("a string is cut off")
    return data[position + _LENGTH.size : end].rstrip(b"\0").decode("utf-8", "replace"), end


def log_of(run: Run, output: Output) -> LogRecord | None:
    """Return the log record of an output of kind LOG; None if it was not kept or is unreadable."""
    try:
        found = run.trace.payload(output)
        channel = run.trace.channel_of(output)
        if found is None or channel is None or channel.type != LOG_TYPE:
            return None
        return parse_log(found[2])
    except (TraceError, ValueError):
        return None


def output_text(run: Run, output: Output) -> str:
    """Return one output as a few words: ``/odom``, ``call /plan``, ``log WARN too far``."""
    name = run.entity_name(output.entity)
    kind = output.kind
    if kind is OutputKind.MESSAGE:
        return name
    if kind is OutputKind.REQUEST:
        return f"call {name}"
    if kind is OutputKind.RESPONSE:
        return f"reply {name}"
    if kind is OutputKind.LOG:
        record = log_of(run, output)
        return printable(f"log {record.level_name} {record.text}") if record else "log"
    if kind is OutputKind.DRAW:
        entity = run.entities.get(output.entity)
        node = run.entities.get(entity.node) if entity is not None else None
        return draw_text(output.hash) + (f" ({printable(node.name)})" if node is not None else "")
    if kind is OutputKind.ENTITY:
        entity = run.entities.get(output.entity)
        return f"new {entity.kind.label} {name}" if entity else f"new {name}"
    try:
        detail = (run.trace.detail(output) or "").strip()
    except TraceError:
        detail = ""
    if kind is OutputKind.EXCEPTION:
        return printable(f"exception {detail.splitlines()[-1] if detail else ''}").rstrip()
    return f"{kind.label} {name}".rstrip() + (f" ({printable(detail)})" if detail else "")


def outputs_text(run: Run, outputs: list[Output], width: int = _SUMMARY_MAX) -> str:
    """Return all outputs of an event as one line; equal ones next to each other are counted."""
    parts: list[str] = []
    repeated = 0
    for place, output in enumerate(outputs):
        text = output_text(run, output)
        following = outputs[place + 1] if place + 1 < len(outputs) else None
        if (
            following is not None
            and output.kind is OutputKind.MESSAGE
            and (following.kind, following.entity) == (output.kind, output.entity)
        ):
            repeated += 1
            continue
        parts.append(f"{text} ×{repeated + 1}" if repeated else text)
        repeated = 0
        if sum(map(len, parts)) > width:
            break
    return shortened(", ".join(parts), width)
