"""A decoded message as lines of a tree; only what is open is made."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import field
from enum import Enum
from typing import Any

import numpy as np

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.texts import PLACEHOLDERS, printable, shortened

# Lines of the inspector: a tree written as lines with depths, opened where one wants to look.
#
# What is open is remembered by path (``in.pose.pose``), not by event, so stepping through a topic
# keeps showing the field one cares about.


class Role(Enum):
    SECTION = "section"
    FIELD = "field"
    BYTES = "bytes"
    NOTE = "note"
    LINK = "link"
    ERROR = "error"
    WARNING = "warning"
    DIFFERENCE = "difference"
    SAME = "same"


@dataclass(frozen=True, slots=True)
class Line:
    """One line. ``path`` names it among all; ``open`` is None where there is nothing inside.

    ``link`` is the index of an event to go to; ``other_run`` says that it is one of run b.
    """

    depth: int
    label: str
    value: str
    role: Role
    path: str
    open: bool | None = None
    link: int | None = None
    other_run: bool = False


@dataclass
class Openness:
    """Which paths are open. Everything starts as its builder says; toggling turns that around."""

    toggled: set[str] = field(default_factory=set)

    def is_open(self, path: str, default: bool) -> bool:
        return default != (path in self.toggled)

    def toggle(self, path: str) -> None:
        self.toggled ^= {path}


_PREVIEW = 120
_ITEMS_PER_LEVEL = 100
_SMALL = 8


def message_lines(value: object, path: str, depth: int, openness: Openness) -> Iterator[Line]:
    """Yield the lines of a decoded message's fields (not of the message itself)."""
    children = list(_children(value))
    if not children:
        yield Line(depth, "", "(no fields)", Role.NOTE, f"{path}.")
    few = len(children) <= _SMALL
    for name, child in children:
        yield from _value_lines(name, child, f"{path}.{name}", depth, openness, few)


def _value_lines(
    name: str, value: object, path: str, depth: int, openness: Openness, few: bool
) -> Iterator[Line]:
    if not _has_inside(value):
        yield Line(depth, name, preview(value), Role.FIELD, path)
        return
    is_open = openness.is_open(path, few and _is_message(value) and not _is_time(value))
    yield Line(
        depth,
        name,
        "" if is_open and _is_message(value) else preview(value),
        Role.FIELD,
        path,
        is_open,
    )
    if not is_open:
        return
    children = list(_children(value))
    nested_few = few and len(children) <= 4
    for child_name, child in children:
        child_path = f"{path}.{child_name}"
        yield from _value_lines(child_name, child, child_path, depth + 1, openness, nested_few)


@dataclasses.dataclass(frozen=True, slots=True)
class _Slice:
    """A part of a long array: opened like a message, so that a million items stay a line."""

    values: Any
    start: int
    end: int


def _children(value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, _Slice):
        yield from _items(value.values, value.start, value.end)
    elif isinstance(value, (list, np.ndarray)):
        yield from _items(value, 0, len(value))
    elif _is_message(value):
        for field in dataclasses.fields(value):  # type: ignore[arg-type]  # an instance of one
            if field.name not in PLACEHOLDERS:
                yield field.name.rstrip("_"), getattr(value, field.name)


def _items(values: Any, start: int, end: int) -> Iterator[tuple[str, object]]:
    count = end - start
    if count <= _ITEMS_PER_LEVEL:
        for place in range(start, end):
            yield f"[{place}]", values[place]
        return
    size = _ITEMS_PER_LEVEL
    while -(-count // size) > _ITEMS_PER_LEVEL:
        size *= _ITEMS_PER_LEVEL
    for first in range(start, end, size):
        last = min(first + size, end)
        yield f"[{first}…{last - 1}]", _Slice(values, first, last)


def _is_message(value: object) -> bool:
    return (
        dataclasses.is_dataclass(value)
        and not isinstance(value, type)
        and not isinstance(value, _Slice)
    )


def _is_time(value: object) -> bool:
    return str(getattr(value, "__msgtype__", "")) in (
        "builtin_interfaces/msg/Time",
        "builtin_interfaces/msg/Duration",
    )


def _has_inside(value: object) -> bool:
    if isinstance(value, (list, np.ndarray)):
        return len(value) > 0
    return isinstance(value, _Slice) or (_is_message(value) and any(True for _ in _children(value)))


def preview(value: object, width: int = _PREVIEW) -> str:
    """Return a value as one line of at most ``width`` characters."""
    text = ""
    for part in _parts(value):
        text += part
        if len(text) > width:
            break
    return shortened(printable(text), width)


def _parts(value: object) -> Iterator[str]:
    if isinstance(value, _Slice):
        yield from _array_parts(value.values[value.start : value.end])
    elif isinstance(value, (list, np.ndarray)):
        if len(value) > 3:
            yield f"{len(value)}: "
        yield from _array_parts(value)
    elif _is_time(value):
        yield f"{getattr(value, 'sec', 0)}.{getattr(value, 'nanosec', 0):09d}"
    elif _is_message(value):
        yield "{"
        for place, (name, child) in enumerate(_children(value)):
            yield f"{', ' if place else ''}{name}: "
            yield from _parts(child)
        yield "}"
    elif isinstance(value, str):
        yield f'"{value}"'
    elif isinstance(value, (bool, np.bool_)):
        yield "true" if value else "false"
    elif isinstance(value, np.generic):
        yield str(value)
    else:
        yield repr(value) if isinstance(value, float) else str(value)


def _array_parts(values: Any) -> Iterator[str]:
    yield "["
    for place in range(len(values)):
        yield ", " if place else ""
        yield from _parts(values[place])
    yield "]"


def bytes_lines(data: bytes, path: str, depth: int) -> Iterator[Line]:
    """Yield lines with the bytes of a message that cannot be decoded."""
    shown = 256
    for offset in range(0, min(len(data), shown), 16):
        row = data[offset : offset + 16]
        text = "".join(chr(b) if 32 <= b < 127 else "." for b in row)
        yield Line(
            depth, f"{offset:06x}", f"{row.hex(' ')}  {text}", Role.BYTES, f"{path}.{offset}"
        )
    if len(data) > shown:
        more = f"… and {len(data) - shown} more bytes"
        yield Line(depth, "", more, Role.NOTE, f"{path}.more")
