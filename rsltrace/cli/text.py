"""Text on a terminal or in a pipe: aligned, stable, and safe whatever a trace contains."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

_NOT_PRINTABLE = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\u202a-\u202e\u2066-\u2069]"
)
_SHORT = {"\n": r"\n", "\r": r"\r", "\t": r"\t"}


def printable(text: str) -> str:
    """Return ``text`` on one line, with what could steer a terminal written as escapes.

    Names and log texts come from the trace, and a trace may come from anybody.
    """
    return _NOT_PRINTABLE.sub(_escaped, text)


def _escaped(match: re.Match[str]) -> str:
    character = match.group()
    return _SHORT.get(character) or character.encode("unicode_escape").decode("ascii")


def table(rows: Iterable[Sequence[str]], *, right: frozenset[int] = frozenset()) -> list[str]:
    """Return ``rows`` as lines with aligned columns, two spaces apart.

    ``right`` names the columns that are aligned to the right. No line ends in spaces.
    """
    cells = [list(row) for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = []
    for row in cells:
        padded = [
            cell.rjust(width) if place in right else cell.ljust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(padded).rstrip())
    return lines
