"""A number that is equal for two messages exactly when nothing that is compared differs in them.

The bytes of a recording do not serve: recorders leave garbage in the padding, and fields that are
not compared would count. So the key is made of the decoded fields, bit for bit.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import xxhash

from rsltrace.diff.values.fields import fields_of
from rsltrace.diff.values.globs import FieldRules

_LENGTH = struct.Struct("<Q").pack
_FLOAT = struct.Struct("<d").pack
_PLAIN = frozenset((float, int, bool, str, np.ndarray))


class ContentKeys:
    """Makes keys of messages under one set of rules."""

    def __init__(self, rules: FieldRules) -> None:
        self._rules = rules
        self._ignored: dict[str, bool] = {}
        self._elements: dict[tuple[str, int], Any] = {}

    def key(self, message: object) -> int:
        """Return the 64-bit key of a decoded message."""
        parts: list[bytes] = []
        if self._rules.empty:
            _add_all(parts, message)
        else:
            self._add(parts, "", message)
        return xxhash.xxh3_64_intdigest(b"".join(parts))

    def _add(self, parts: list[bytes], path: str, value: Any) -> None:
        """Add what is compared of a value."""
        kind = type(value)
        if kind is np.ndarray:
            _add_all(parts, self._without_ignored(path, value))
        elif kind in _PLAIN:
            _add_all(parts, value)
        elif kind is list:
            parts.append(_LENGTH(len(value)))
            for place, item in enumerate(value):
                inner = f"{path}[{place}]"
                if type(item) is not str or not self._is_ignored(inner):
                    self._add(parts, inner, item)
        else:
            prefix = f"{path}." if path else ""
            for name, attribute, _ in fields_of(value):
                inner = prefix + name
                if not self._is_ignored(inner):
                    self._add(parts, inner, getattr(value, attribute))

    def _is_ignored(self, path: str) -> bool:
        known = self._ignored.get(path)
        if known is None:
            known = self._ignored[path] = self._rules.ignored(path)
        return known

    def _without_ignored(self, path: str, values: Any) -> Any:
        """Return an array with zeros where single elements are not compared."""
        if not self._rules.by_element:
            return values
        place = (path, len(values))
        mask = self._elements.get(place)
        if mask is None:
            ignored = [self._rules.ignored(f"{path}[{index}]") for index in range(len(values))]
            mask = self._elements[place] = np.array(ignored, dtype=bool)
        if not mask.any():
            return values
        values = values.copy()
        values[mask] = 0
        return values


def _add_all(parts: list[bytes], value: Any) -> None:
    """Add a value with all that is in it, without building the paths of its fields."""
    kind = type(value)
    if kind is float:
        parts.append(_FLOAT(value))
    elif kind is int or kind is bool:
        parts.append(value.to_bytes(9, "little", signed=True))
    elif kind is str:
        encoded = value.encode("utf-8", "surrogatepass")
        parts += (_LENGTH(len(encoded)), encoded)
    elif kind is np.ndarray:
        parts += (_LENGTH(len(value)), value.tobytes())
    elif kind is list:
        parts.append(_LENGTH(len(value)))
        for item in value:
            _add_all(parts, item)
    else:
        for _, attribute, _ in fields_of(value):
            _add_all(parts, getattr(value, attribute))
