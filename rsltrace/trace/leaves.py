"""The fields of a type that hold values, at any depth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rosbags.interfaces import Nodetype

from rsltrace.trace.cdr import WIDE_TEXT_TYPE
from rsltrace.trace.model.texts import NO_FIELD

_DEPTH_MAX = 6


@dataclass(frozen=True, slots=True)
class ValueField:
    """A field by its name, with ``[]`` behind each array, and the type of one value (``float32``,
    ``string``; "" for messages).

    With ``length_max`` it is an array itself, with at most that many items.
    """

    name: str
    type: str
    length_max: int | None = None


def leaves_of(name: str, types: dict[str, Any]) -> list[ValueField]:
    """Return the value fields of a type, which is defined in ``types``."""
    return list(_leaves(name, types, "", _DEPTH_MAX))


def _leaves(of: str, types: dict[str, Any], prefix: str, depth: int) -> Iterator[ValueField]:
    for field, description in types[of][1]:
        name, (kind, detail) = f"{prefix}{field}", description
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (inner, inner_detail), size = detail
            if kind == Nodetype.SEQUENCE:
                base = inner_detail[0] if inner == Nodetype.BASE else ""
                yield ValueField(name, base, size or 1 << 20)
            name, kind, detail = f"{name}[]", inner, inner_detail
        if kind == Nodetype.BASE:
            if field != NO_FIELD:
                yield ValueField(name, detail[0])
        elif detail == WIDE_TEXT_TYPE:
            yield ValueField(name, "string")
        elif depth > 1:
            yield from _leaves(detail, types, f"{name}.", depth - 1)
