"""rsltrace's own messages with strings, as CDR.

Events and outputs have a fixed size and are packed by ``struct``; the others are few and small, and
need four rules of CDR, not a code generator.
"""

from __future__ import annotations

import dataclasses
import json
import re
import struct
from typing import Any

from rsltrace.errors import TraceError
from rsltrace.trace.format import CDR_HEADER
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import CodeLine
from rsltrace.trace.model.finding import Finding, GuardMode, NondeterminismSource

# Strings of 16-bit characters (``wstring``), which rosbags does not read. In CDR, as ROS 2 writes
# it, each is a sequence of 32-bit numbers, one per UTF-16 unit. So a schema is read with a message
# of such a sequence instead, which becomes a string once decoded.

_WIDE_TEXT = "rsltrace_wide/Text"
WIDE_TEXT_TYPE = "rsltrace_wide/msg/Text"
_DEFINITION = f"\n{'=' * 80}\nMSG: {_WIDE_TEXT}\nuint32[] units\n"
_FIELD = re.compile(
    r"^([ \t]*)wstring(?:<=\d+)?(\[[^\]\n]*\])?([ \t]+[A-Za-z]\w*)[ \t]*"
    r"(?:(=.*)|[\"'].*|#.*)?$",
    re.MULTILINE | re.ASCII,
)


def replace_wide_texts(schema: str) -> str:
    """Return a schema with another type for all wide strings; the same object if it has none."""
    if "wstring" not in schema:
        return schema
    replaced, count = _FIELD.subn(_replaced, schema)
    return replaced + _DEFINITION if count else schema


def _replaced(field: re.Match[str]) -> str:
    indent, array, name, constant = field.groups()
    if constant:
        return f"{indent}string{name}{constant}"
    return f"{indent}{_WIDE_TEXT}{array or ''}{name}"


def restore_wide_texts(value: Any) -> Any:
    """Return a decoded message with strings where its schema has wide strings.

    Raises ValueError for invalid UTF-16.
    """
    if isinstance(value, list):
        return [restore_wide_texts(item) for item in value]
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    if getattr(value, "__msgtype__", "") == WIDE_TEXT_TYPE:
        units: Any = getattr(value, "units")  # noqa: B009 (of a class made at run time)
        if len(units) and units.max() > 0xFFFF:
            raise ValueError("a character of a wide text is larger than 16 bits")
        return units.astype("<u2").tobytes().decode("utf-16-le")
    for field in dataclasses.fields(value):
        inner = getattr(value, field.name)
        if isinstance(inner, list) or dataclasses.is_dataclass(inner):
            setattr(value, field.name, restore_wide_texts(inner))
    return value


_ENTITY_HEAD = struct.Struct("<IIB")
_DETAIL_HEAD = struct.Struct("<QI")
_LINE_HEAD = struct.Struct("<QII")
_LOG_HEAD = struct.Struct("<iIB")
_LENGTH = struct.Struct("<I")
_KINDS = frozenset(map(int, EntityKind))


def pack_entity(entity: Entity) -> bytes:
    """Return an ``rsltrace_msgs/msg/Entity``. Its ``created_ns`` is the time of the message."""
    head = CDR_HEADER + _ENTITY_HEAD.pack(entity.id, entity.node, entity.kind)
    # Sorted keys: equal details give equal bytes.
    detail = json.dumps(entity.detail, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return _append_strings(head, entity.name, entity.type, detail)


def unpack_entity(data: bytes, created_ns: int) -> Entity:
    """Return the entity of a message. Raises TraceError for invalid bytes."""
    try:
        _check_header(data)
        entity_id, node, kind = _ENTITY_HEAD.unpack_from(data, 4)
        name, type_name, detail_text = _read_strings(data, 4 + _ENTITY_HEAD.size, 3)
        detail = _json(detail_text)
        if not isinstance(detail, dict):
            raise ValueError("its detail is not a JSON object")
        if kind not in _KINDS:
            raise ValueError(f"it is of kind {kind}, which only a newer rsltrace knows")
        return Entity(entity_id, node, EntityKind(kind), name, type_name, created_ns, detail)
    except (struct.error, ValueError, RecursionError) as error:
        raise TraceError(f"an entity of the trace cannot be read: {error}") from error


def _json(text: str) -> object:
    try:
        return json.loads(text)
    except ValueError as error:
        raise ValueError(f"its detail is no JSON: {error}") from None


def pack_detail(event: int, output: int, text: str) -> bytes:
    """Return an ``rsltrace_msgs/msg/Detail``: the text of one output of one event."""
    return _append_strings(CDR_HEADER + _DETAIL_HEAD.pack(event, output), text)


def unpack_detail(data: bytes) -> tuple[int, int, str]:
    """Return (event, output, text). Raises TraceError for invalid bytes."""
    try:
        _check_header(data)
        event, output = _DETAIL_HEAD.unpack_from(data, 4)
        (text,) = _read_strings(data, 4 + _DETAIL_HEAD.size, 1)
        return event, output, text
    except (struct.error, ValueError) as error:
        raise TraceError(f"a detail of the trace cannot be read: {error}") from error


def pack_finding(finding: Finding) -> bytes:
    """Return an ``rsltrace_msgs/msg/Finding``."""
    head = CDR_HEADER + _DETAIL_HEAD.pack(finding.event, finding.entity)
    texts = (finding.source.value, finding.mode.value, finding.call, finding.value, finding.stack)
    return _append_strings(head, finding.node, *texts)


def unpack_finding(data: bytes) -> Finding:
    """Return the finding of a message. Raises TraceError for invalid bytes."""
    try:
        _check_header(data)
        event, entity = _DETAIL_HEAD.unpack_from(data, 4)
        node, source, mode, *texts = _read_strings(data, 4 + _DETAIL_HEAD.size, 6)
        return Finding(event, entity, node, NondeterminismSource(source), GuardMode(mode), *texts)
    except (struct.error, ValueError) as error:
        raise TraceError(f"a finding of the trace cannot be read: {error}") from error


def pack_code_line(line: CodeLine) -> bytes:
    """Return an ``rsltrace_msgs/msg/CodeLine``."""
    head = CDR_HEADER + _LINE_HEAD.pack(line.event, line.entity, line.output)
    return _append_strings(head, line.place, line.function)


def unpack_code_line(data: bytes) -> CodeLine:
    """Return the code line of a message. Raises TraceError for invalid bytes."""
    try:
        _check_header(data)
        head = _LINE_HEAD.unpack_from(data, 4)
        return CodeLine(*head, *_read_strings(data, 4 + _LINE_HEAD.size, 2))
    except (struct.error, ValueError) as error:
        raise TraceError(f"a place in the code cannot be read: {error}") from error


def log_content(data: bytes, stamp_ns: int | None = None) -> bytes:
    """Return the hashed content of an ``rcl_interfaces/msg/Log``: severity, name and message.

    Empty for other bytes, or if its time is not ``stamp_ns``.
    """
    try:
        _check_header(data)
        sec, nanosec, severity = _LOG_HEAD.unpack_from(data, 4)
        if stamp_ns is not None and sec * 10**9 + nanosec != stamp_ns:
            return b""
        name, message = _read_bytes(data, 4 + _LOG_HEAD.size, 2)
        return b"%d\0%s\0%s" % (severity, name, message)
    except (struct.error, ValueError):
        return b""


def _append_strings(head: bytes, *texts: str) -> bytes:
    data = bytearray(head)
    for text in texts:
        data += bytes(-(len(data) - 4) % 4)  # a string's length is aligned to 4, after the header
        # A name may contain invalid Unicode (surrogates from os.fsdecode): keep it readable.
        encoded = text.encode("utf-8", "backslashreplace") + b"\0"
        data += _LENGTH.pack(len(encoded)) + encoded
    return bytes(data)


def _check_header(data: bytes) -> None:
    if data[:4] != CDR_HEADER:
        raise ValueError("it is not little-endian CDR")


def _read_strings(data: bytes, offset: int, count: int) -> list[str]:
    return [text.decode("utf-8") for text in _read_bytes(data, offset, count)]


def _read_bytes(data: bytes, offset: int, count: int) -> list[bytes]:
    texts = []
    for _ in range(count):
        offset += -(offset - 4) % 4
        (length,) = _LENGTH.unpack_from(data, offset)
        end = offset + 4 + length
        if length == 0 or end > len(data) or data[end - 1] != 0:
            raise ValueError("a string in it is cut off")
        texts.append(data[offset + 4 : end - 1])
        offset = end
    return texts
