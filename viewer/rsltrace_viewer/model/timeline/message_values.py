"""A message in a few words, for a row: ``x=0.31 ω=-0.05``. What is zero or long is left out."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from rsltrace.model.printable import printable, shortened

_NOT_SHOWN = frozenset(("structure_needs_at_least_one_member", "__msgtype__", "header", "stamp"))
_VALUES_MAX = 5
_LEAVES_MAX = 60
_TEXT_MAX = 30
_TURNS = {"x": "ωx", "y": "ωy", "z": "ω"}


def message_values(message: object) -> str:
    """Return the values of a decoded message that tell most."""
    leaves = list(_leaves(message, ""))[:_LEAVES_MAX]
    told = [leaf for leaf in leaves if leaf[1] not in ("0", "false", '""', "[]")] or leaves[:2]
    # Names of frames and the like rarely change: they come last.
    told = sorted(told, key=lambda leaf: leaf[1].startswith('"'))[:_VALUES_MAX]
    short = Counter(path.rpartition(".")[2] for path, _ in told)
    parts = []
    for path, value in told:
        name = path.rpartition(".")[2]
        if short[name] > 1:
            name = ".".join(path.split(".")[-2:])
        parts.append(f"{name}={value}" if len(leaves) > 1 else value)
    return printable(" ".join(parts))


def _leaves(value: Any, path: str) -> Iterator[tuple[str, str]]:
    if isinstance(value, (bool, np.bool_)):
        yield path, "true" if value else "false"
    elif isinstance(value, (int, float, np.number)):
        yield path, number(float(value)) if isinstance(value, (float, np.floating)) else str(value)
    elif isinstance(value, str):
        yield path, f'"{shortened(value, _TEXT_MAX)}"'
    elif isinstance(value, (list, np.ndarray)):
        if "covariance" not in path:
            yield path, _items(value)
    elif dataclasses.is_dataclass(value):
        yield from _fields(value, path)


def _fields(message: Any, path: str) -> Iterator[tuple[str, str]]:
    names = [f.name for f in dataclasses.fields(message) if f.name not in _NOT_SHOWN]
    if names == ["x", "y", "z", "w"]:  # a quaternion: on the ground the turn is what one looks for
        yield f"{path}.θ".lstrip("."), number(_yaw(*(float(getattr(message, n)) for n in names)))
        return
    turns = "angular" in path and names == ["x", "y", "z"]
    for name in names:
        inner = _TURNS[name] if turns else name.rstrip("_")
        yield from _leaves(getattr(message, name), f"{path}.{inner}".lstrip("."))


def _items(values: Any) -> str:
    if not len(values):
        return "[]"
    if len(values) <= 3 and not dataclasses.is_dataclass(values[0]):
        return "[" + " ".join(value for item in values for _, value in _leaves(item, "")) + "]"
    return f"[{len(values)}]"


def _yaw(x: float, y: float, z: float, w: float) -> float:
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def number(value: float) -> str:
    """Return a number in three digits behind the first: ``0.31``, ``1.234e+06``."""
    text = f"{value:.4g}"
    return "0" if text == "-0" else text
