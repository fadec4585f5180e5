"""Texts of 16-bit characters (``wstring``), which rosbags does not read.

In CDR, as ROS 2 writes it, one is a sequence of numbers of 32 bits, a UTF-16 unit in each. So a
schema is read with a message of such a sequence in its place, which becomes a text once decoded.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

_STAND_IN = "rsltrace_wide/Text"
STAND_IN_TYPE = "rsltrace_wide/msg/Text"
_DEFINITION = f"\n{'=' * 80}\nMSG: {_STAND_IN}\nuint32[] units\n"
_FIELD = re.compile(
    r"^([ \t]*)wstring(?:<=\d+)?(\[[^\]\n]*\])?([ \t]+[A-Za-z]\w*)[ \t]*"
    r"(?:(=.*)|[\"'].*|#.*)?$",
    re.MULTILINE | re.ASCII,
)


def without_wide_texts(schema: str) -> str:
    """Return a schema in which all wide texts are of another type; itself if it has none."""
    if "wstring" not in schema:
        return schema
    replaced, count = _FIELD.subn(_replaced, schema)
    return replaced + _DEFINITION if count else schema


def _replaced(field: re.Match[str]) -> str:
    indent, array, name, constant = field.groups()
    if constant:
        return f"{indent}string{name}{constant}"
    return f"{indent}{_STAND_IN}{array or ''}{name}"


def with_wide_texts(value: Any) -> Any:
    """Return a decoded message with texts where its schema has wide texts.

    Raises ValueError for what is no UTF-16.
    """
    if isinstance(value, list):
        return [with_wide_texts(item) for item in value]
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    if getattr(value, "__msgtype__", "") == STAND_IN_TYPE:
        units: Any = getattr(value, "units")  # noqa: B009 (of a class made at run time)
        if len(units) and units.max() > 0xFFFF:
            raise ValueError("a character of a wide text is larger than 16 bits")
        return units.astype("<u2").tobytes().decode("utf-16-le")
    for field in dataclasses.fields(value):
        inner = getattr(value, field.name)
        if isinstance(inner, list) or dataclasses.is_dataclass(inner):
            setattr(value, field.name, with_wide_texts(inner))
    return value
