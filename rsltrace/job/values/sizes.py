"""Sizes in a job: a number of bytes, or a number with a unit (``4MiB``)."""

from __future__ import annotations

import re
from fractions import Fraction

from rsltrace.job.values.problem import Problem, describe

UNITS = {
    "B": 1,
    "kB": 10**3,
    "MB": 10**6,
    "GB": 10**9,
    "TB": 10**12,
    "KiB": 2**10,
    "MiB": 2**20,
    "GiB": 2**30,
    "TiB": 2**40,
}
SIZE_MAX = 2**63 - 1

SIZE_SCHEMA: dict[str, object] = {
    "x-words": "size",
    "anyOf": [
        {"type": "integer", "minimum": 1},
        {"type": "string", "pattern": r"^\s*[0-9]+(\.[0-9]+)?\s*([kMGT]B|[KMGT]iB|B)\s*$"},
    ],
}

_SIZE_TEXT = re.compile(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([A-Za-z]*)\s*", re.ASCII)
_EXPECTED = f"expected a size: a number of bytes, or a number with a unit ({', '.join(UNITS)})"


def parse_size(value: object) -> int:
    """Return a size of a job in bytes. Raises ``ValueError`` unless it is a whole number."""
    if isinstance(value, bool) or not isinstance(value, (int, str)):
        raise Problem(f"{_EXPECTED}, got {describe(value)}")
    if isinstance(value, int):
        return _checked(Fraction(value), str(value))
    match = _SIZE_TEXT.fullmatch(value)
    if match is None:
        raise Problem(f"{_EXPECTED}, got {describe(value)}")
    number, unit = match.groups()
    if not unit:
        raise Problem(f"{value!r} has no unit: write '{number}B' for bytes")
    if unit not in UNITS:
        near = [known for known in UNITS if known.lower() in (unit.lower(), f"{unit.lower()}b")]
        hint = f"did you mean {' or '.join(near)}?" if near else f"units are {', '.join(UNITS)}"
        raise Problem(f"unknown unit {unit!r} in {value!r}; {hint}")
    return _checked(Fraction(number) * UNITS[unit], value.strip())


def format_size(size: int) -> str:
    """Return the shortest text that ``parse_size`` reads back exactly: ``4MiB``."""
    for unit, factor in sorted(UNITS.items(), key=lambda item: -item[1]):
        if size % factor == 0:
            return f"{size // factor}{unit}"
    raise AssertionError("bytes divide every size")


def _checked(size: Fraction, shown: str) -> int:
    if size.denominator != 1:
        raise Problem(f"{shown} is not a whole number of bytes")
    if not 1 <= size <= SIZE_MAX:
        raise Problem(f"a size must be from 1B to {format_size(2**62)}, got {shown}")
    return int(size)


parse_size.schema = SIZE_SCHEMA  # type: ignore[attr-defined]
