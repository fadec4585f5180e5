"""Recorded states of a node: which attribute changed in which event, down to array elements.

Only changes since the node's last event are written: attributes by their hash, arrays in blocks.
"""

from __future__ import annotations

import base64
import collections
import enum
from collections.abc import Mapping
from typing import Any

import numpy as np

from rsltrace.guard.state.hashing import StateHasher, attributes_of, is_left_out

LEAVES_MAX = 20_000
"""An attribute with more values is recorded by its hash only."""

BLOCK_BYTES = 4096

_Arrays = dict[str, tuple[str, list[bytes]]]
"""Arrays by path: their type and shape, and their data in blocks."""


class Snapshots:
    """Records the states of one node as changes."""

    def __init__(self) -> None:
        self._attributes: dict[str, int] = {}
        self._arrays: dict[str, _Arrays] = {}
        """By attribute, its arrays when it was last written: a reader knows only those."""

    def changes(self, attributes: Mapping[str, Any], hashes: Mapping[str, int]) -> dict[str, Any]:
        """Return what changed: by attribute its values by path (None: it is gone)."""
        changed: dict[str, Any] = {}
        for name in self._attributes.keys() - hashes.keys():
            changed[name] = None
            self._arrays.pop(name, None)
        for name, digest in hashes.items():
            if self._attributes.get(name) != digest:
                leaves = _Leaves(self._arrays.pop(name, {}))
                try:
                    leaves.add(attributes[name], name)
                except _TooMany:
                    text = f"(more than {LEAVES_MAX} values, hash {digest:016x})"
                    changed[name] = {name: text}
                    continue
                changed[name] = leaves.found
                if leaves.arrays:
                    self._arrays[name] = leaves.arrays
        self._attributes = dict(hashes)
        return dict(sorted(changed.items()))


class _Leaves:
    """The values of one attribute by path; of arrays, the blocks that changed."""

    def __init__(self, before: _Arrays) -> None:
        self._before = before
        self._parents: set[int] = set()
        self.found: dict[str, Any] = {}
        self.arrays: _Arrays = {}

    def add(self, value: Any, path: str) -> None:
        if len(self.found) >= LEAVES_MAX:
            raise _TooMany
        if isinstance(value, np.ndarray) and value.dtype.kind in "biufcmM":
            self.found[path] = self._array(path, value)
            return
        parents, key = self._parents, id(value)
        children = None if key in parents else _children(value, path)
        if children is None:
            self.found[path] = _text(value, is_parent=key in parents)
            return
        if not children:
            self.found[path] = "empty"
        parents.add(key)
        for child, item in children:
            self.add(item, child)
        parents.discard(key)

    def _array(self, path: str, value: Any) -> dict[str, Any]:
        data = np.ascontiguousarray(value).tobytes()
        kind = f"{value.dtype.str} {list(value.shape)}"
        blocks = [data[at : at + BLOCK_BYTES] for at in range(0, len(data), BLOCK_BYTES)]
        before_kind, before = self._before.get(path, ("", []))
        if before_kind != kind:
            before = []
        self.arrays[path] = (kind, blocks)
        new = {
            str(number): base64.b64encode(block).decode()
            for number, block in enumerate(blocks)
            if number >= len(before) or before[number] != block
        }
        return {"dtype": value.dtype.str, "shape": list(value.shape), "blocks": new}


class _TooMany(Exception):
    pass


def _children(value: Any, path: str) -> list[tuple[str, Any]] | None:
    """Return the parts of a value with their paths, or None if it has none."""
    if isinstance(value, (str, bytes, bytearray, enum.Enum, type)) or is_left_out(value):
        return None
    if isinstance(value, Mapping):
        return [(f"{path}[{key!r}]", item) for key, item in value.items()]
    if isinstance(value, (list, tuple, collections.deque, np.ndarray)):
        return [(f"{path}[{number}]", item) for number, item in enumerate(value)]
    if isinstance(value, (set, frozenset)):
        return None
    hook = getattr(value, "rsltrace_state", None)
    if callable(hook):
        return _children(hook(), path)
    if getattr(value, "__dict__", None) is not None or hasattr(type(value), "__slots__"):
        found = attributes_of(value)
        return [(f"{path}.{name.lstrip('_')}", item) for name, item in found.items()]
    return None


def _text(value: Any, *, is_parent: bool) -> str:
    if is_parent:
        return "(itself again)"
    if is_left_out(value):
        return f"(left out: {type(value).__qualname__})"
    if isinstance(value, (set, frozenset)):
        return "{" + ", ".join(sorted(map(_plain, value))) + "}"
    return _plain(value)


def _plain(value: Any) -> str:
    text = repr(value)
    if " at 0x" in text:
        return f"{type(value).__qualname__}, hash {StateHasher().digest(value, ''):016x}"
    return text if len(text) <= 1000 else f"{text[:999]}…"
