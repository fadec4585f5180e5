"""Messages of a rich type, written and judged without anything of ours: what an oracle needs.

A message is a dict of plain values. The encoder writes CDR as the specification says, the judge
compares the values themselves.
"""

from __future__ import annotations

import re
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import isfinite, isnan
from pathlib import Path
from typing import Any

TYPE = "truth_msgs/msg/All"
SCHEMA = """\
builtin_interfaces/Time stamp
bool flag
int8 small
uint64 large
float32 narrow
float64 wide
string text
float64[] numbers
float32[3] triple
bool[] flags
uint8[] bytes
int64[<=8] whole
string[] names
truth_msgs/Inner[] inners
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: truth_msgs/Inner
float64 x
string s
float32[] more
"""
INNER = {"x": "float64", "s": "string", "more": "float32[]"}
FIELDS = {
    "stamp": "time",
    "flag": "bool",
    "small": "int8",
    "large": "uint64",
    "narrow": "float32",
    "wide": "float64",
    "text": "string",
    "numbers": "float64[]",
    "triple": "float32[3]",
    "flags": "bool[]",
    "bytes": "uint8[]",
    "whole": "int64[]",
    "names": "string[]",
    "inners": "inner[]",
}
_FORMATS = {
    "bool": "?",
    "int8": "b",
    "uint8": "B",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}


class _Writer:
    def __init__(self, padding: int) -> None:
        self.data = bytearray()
        self._padding = padding

    def number(self, code: str, value: Any) -> None:
        size = struct.calcsize(code)
        self.data += bytes([self._padding]) * (-len(self.data) % size)
        self.data += struct.pack(f"<{code}", value)

    def value(self, kind: str, value: Any) -> None:
        if kind.endswith("]"):
            base, _, size = kind[:-1].partition("[")
            if not size:
                self.number("I", len(value))
            for item in value:
                self.value(base, item)
        elif kind == "string":
            encoded = value.encode() + b"\0"
            self.number("I", len(encoded))
            self.data += encoded
        elif kind == "time":
            self.number("i", value[0])
            self.number("I", value[1])
        elif kind == "inner":
            for name, inner in INNER.items():
                self.value(inner, value[name])
        else:
            self.number(_FORMATS[kind], value)


def encoded(message: dict[str, Any], padding: int = 0) -> bytes:
    """Return a message as CDR; ``padding`` is the byte between its fields."""
    writer = _Writer(padding)
    for name, kind in FIELDS.items():
        writer.value(kind, message[name])
    return b"\0\1\0\0" + bytes(writer.data)


Sample = tuple[int, str, bytes]
"""Log time in ns, topic, CDR."""


def write_mcap(
    path: Path, samples: Sequence[Sample], *, compression: str, chunk: int, channels: int = 1
) -> None:
    """Write a recording; chunks of ``chunk`` bytes (0: none), ``channels`` for each topic."""
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=chunk or 1,
            use_chunking=bool(chunk),
            compression=CompressionType[compression],
        )
        writer.start(profile="ros2", library="judge")
        schema = writer.register_schema(TYPE, "ros2msg", SCHEMA.encode())
        known: dict[tuple[str, int], int] = {}
        for number, (stamp, topic, data) in enumerate(samples):
            key = topic, number % channels
            if key not in known:
                known[key] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(known[key], stamp, data, stamp, number)
        writer.finish()


def write_sqlite(path: Path, samples: Sequence[Sample]) -> None:
    """Write a recording as rosbag2's sqlite3 storage has it."""
    database = sqlite3.connect(path)
    database.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
        " serialization_format TEXT, offered_qos_profiles TEXT, type_description_hash TEXT);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
        " data BLOB);"
        "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT,"
        " encoded_message_definition TEXT, type_description_hash TEXT);"
        "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
    )
    topics = {topic: number for number, topic in enumerate(dict.fromkeys(s[1] for s in samples), 1)}
    for topic, number in topics.items():
        database.execute(
            "INSERT INTO topics VALUES (?, ?, ?, 'cdr', '', '')", (number, topic, TYPE)
        )
    database.execute(
        "INSERT INTO message_definitions VALUES (1, ?, 'ros2msg', ?, '')", (TYPE, SCHEMA)
    )
    for stamp, topic, data in samples:
        database.execute(
            "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)",
            (topics[topic], stamp, data),
        )
    database.commit()
    database.close()


# -- the judge ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rules:
    """What is not compared, and what may differ by how much; globs as users write them."""

    ignore: tuple[str, ...] = ()
    absolute: tuple[tuple[str, float], ...] = field(default=())
    relative: tuple[tuple[str, float], ...] = field(default=())

    def ignored(self, path: str) -> bool:
        return any(_fits(glob, path) for glob in self.ignore)

    def covers(self, path: str, a: Any, b: Any) -> bool:
        """Whether one of the tolerances of a number holds."""
        absolute = [value for glob, value in self.absolute if _fits(glob, path)]
        relative = [value for glob, value in self.relative if _fits(glob, path)]
        if not absolute and not relative:
            return False
        if isinstance(a, float) and not (isfinite(a) and isfinite(b)):
            return isnan(a) and isnan(b)
        distance, size = abs(a - b), max(abs(a), abs(b))
        return any(distance <= v for v in absolute) or any(distance <= v * size for v in relative)


def _fits(glob: str, path: str) -> bool:
    pattern = re.escape(glob).replace(r"\*", ".*").replace(r"\?", ".")
    ends = [m.start() for m in re.finditer(r"[.\[]", path)] + [len(path)]
    names = {path[:end] for end in ends}
    names |= {re.sub(r"\[\d+\]", "", name) for name in names}
    return any(re.fullmatch(pattern, name) for name in names)


def judged(a: dict[str, Any], b: dict[str, Any], rules: Rules) -> str:
    """Return ``equal``, ``ignored``, ``tolerated`` or ``differing``."""
    found = list(_leaves(a, b))
    left = [(path, kind, x, y) for path, kind, x, y in found if not rules.ignored(path)]
    if not left:
        return "ignored" if found else "equal"
    return "tolerated" if all(_covered(rules, *leaf) for leaf in left) else "differing"


def _covered(rules: Rules, path: str, kind: str, x: Any, y: Any) -> bool:
    if kind == "time":
        x, y = (Fraction(t[0]) + Fraction(t[1], 10**9) for t in (x, y))
        absolute = [Fraction(repr(v)) for g, v in rules.absolute if _fits(g, path)]
        relative = [Fraction(v) for g, v in rules.relative if _fits(g, path)]
        distance, size = abs(x - y), max(abs(x), abs(y))
        return any(distance <= v for v in absolute) or any(distance <= v * size for v in relative)
    return kind in _FORMATS and kind != "bool" and rules.covers(path, x, y)


def _leaves(a: dict[str, Any], b: dict[str, Any]) -> Iterator[tuple[str, str, Any, Any]]:
    for name, kind in FIELDS.items():
        yield from _differing(name, kind, a[name], b[name])


def _differing(path: str, kind: str, x: Any, y: Any) -> Iterator[tuple[str, str, Any, Any]]:
    if kind.endswith("]"):
        base = kind.partition("[")[0]
        if len(x) != len(y):
            yield path, "length", x, y
        for place, (one, other) in enumerate(zip(x, y, strict=False)):
            yield from _differing(f"{path}[{place}]", base, one, other)
    elif kind == "inner":
        for name, inner in INNER.items():
            yield from _differing(f"{path}.{name}", inner, x[name], y[name])
    elif kind in ("float32", "float64"):
        code = _FORMATS[kind]
        if struct.pack(f"<{code}", x) != struct.pack(f"<{code}", y):
            yield path, kind, x, y
    elif x != y:
        yield path, kind, x, y
