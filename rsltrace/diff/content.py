"""A number that is equal for two messages exactly when nothing that is compared differs in them.

The bytes of a recording do not serve: recorders leave garbage in the padding, and fields that are
not compared would count. So the key is made of the decoded fields, bit for bit.
"""

from __future__ import annotations

import dataclasses
import struct
from typing import Any

import numpy as np
import xxhash

from rsltrace.diff.fields import fields_of
from rsltrace.diff.globs import FieldRules

_LENGTH = struct.Struct("<Q")
_FLOAT = struct.Struct("<d")


class ContentKeys:
    """Makes keys of messages under one set of rules."""

    def __init__(self, rules: FieldRules) -> None:
        self._rules = rules
        self._ignored: dict[str, bool] = {}
        self._elements: dict[tuple[str, int], Any] = {}

    def key(self, message: object) -> int:
        """Return the 64-bit key of a decoded message."""
        parts: list[bytes] = []
        self._add(parts, "", message)
        return xxhash.xxh3_64_intdigest(b"".join(parts))

    def _add(self, parts: list[bytes], path: str, value: Any) -> None:
        if isinstance(value, float):
            parts.append(_FLOAT.pack(value))
        elif isinstance(value, int):
            parts.append(value.to_bytes(9, "little", signed=True))
        elif isinstance(value, str):
            encoded = value.encode("utf-8", "surrogatepass")
            parts += (_LENGTH.pack(len(encoded)), encoded)
        elif isinstance(value, np.ndarray):
            parts.append(_LENGTH.pack(len(value)))
            parts.append(self._without_ignored(path, value).tobytes())
        elif isinstance(value, list):
            parts.append(_LENGTH.pack(len(value)))
            for place, item in enumerate(value):
                self._add(parts, f"{path}[{place}]", item)
        elif dataclasses.is_dataclass(value):
            prefix = f"{path}." if path else ""
            for name, attribute, _ in fields_of(value):
                inner = prefix + name
                if self._rules.empty or not self._is_ignored(inner):
                    self._add(parts, inner, getattr(value, attribute))
        else:
            raise TypeError(f"a message does not hold a {type(value).__name__}")

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
