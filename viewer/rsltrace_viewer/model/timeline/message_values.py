"""A message in a few words, for a row: ``x=0.31 ω=-0.05``. What is zero or long is left out."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from rsltrace.trace.model.placeholders import PLACEHOLDERS
from rsltrace.trace.model.printable import printable, shortened

_NOT_SHOWN = PLACEHOLDERS | {"header", "stamp"}
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


def differing_values(a: object, b: object) -> tuple[str, str]:
    """Return the first values in which two decoded messages differ, in full."""
    leaves = [dict(list(_leaves(one, "", in_full=True))[:_LEAVES_MAX]) for one in (a, b)]
    paths = [path for path in leaves[0] if leaves[0][path] != leaves[1].get(path)]
    texts = [
        printable(" ".join(f"{path.rpartition('.')[2]}={one.get(path, '-')}" for path in paths))
        for one in leaves
    ]
    return texts[0], texts[1]


def field_name(path: str, *, whole: bool = False) -> str:
    """Return how a row calls a field: ``x``, of an angular velocity ``ω``; ``whole``: with the
    field it is in. A message that has nothing but ``data`` needs no name."""
    names = path.split(".")
    name = names[-1].rstrip("_")
    if "angular" in names[:-1]:
        name = _TURNS.get(name, name)
    if path == "data":
        return ""
    return ".".join([*names[-2:-1], name]) if whole else name


def _leaves(value: Any, path: str, in_full: bool = False) -> Iterator[tuple[str, str]]:
    if isinstance(value, (bool, np.bool_)):
        yield path, "true" if value else "false"
    elif isinstance(value, (int, np.integer)):
        yield path, str(value)
    elif isinstance(value, (float, np.floating)):
        yield path, repr(float(value)) if in_full else number(float(value))
    elif isinstance(value, str):
        yield path, f'"{shortened(value, _TEXT_MAX)}"'
    elif isinstance(value, (list, np.ndarray)):
        if in_full:
            for place, item in enumerate(value[:_LEAVES_MAX]):
                yield from _leaves(item, f"{path}[{place}]", in_full)
        elif "covariance" not in path:
            yield path, _items(value)
    elif dataclasses.is_dataclass(value):
        yield from _fields(value, path, in_full)


def _fields(message: Any, path: str, in_full: bool) -> Iterator[tuple[str, str]]:
    left_out = PLACEHOLDERS if in_full else _NOT_SHOWN
    names = [f.name for f in dataclasses.fields(message) if f.name not in left_out]
    if names == ["x", "y", "z", "w"] and not in_full:  # a quaternion: its turn is what tells
        yield f"{path}.θ".lstrip("."), number(_yaw(*(float(getattr(message, n)) for n in names)))
        return
    turns = "angular" in path and names == ["x", "y", "z"]
    for name in names:
        inner = _TURNS[name] if turns else name.rstrip("_")
        yield from _leaves(getattr(message, name), f"{path}.{inner}".lstrip("."), in_full)


def _items(values: Any) -> str:
    if not len(values):
        return "[]"
    if len(values) <= 3 and not dataclasses.is_dataclass(values[0]):
        return "[" + " ".join(value for item in values for _, value in _leaves(item, "")) + "]"
    return f"[{len(values)}]"


def _yaw(x: float, y: float, z: float, w: float) -> float:
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def number(value: float, digits: int = 4) -> str:
    """Return a number in so many digits: ``0.31``, ``1.234e+06``."""
    text = f"{value:.{digits}g}"
    return "0" if text == "-0" else text
