"""The line below the lanes: from when to when they go, where one is, and where runs diverge."""

from __future__ import annotations

from collections.abc import Collection

from rsltrace.trace.model.stamp import format_duration, format_seconds
from rsltrace_viewer.model.lanes import Lanes

_MARK = "≠"


def axis_text(
    lanes: Lanes, position: int, cursor: int, divergences: Collection[int], base_ns: int
) -> str:
    """Return the line, one character per column.

    ``position`` is the time (or place) that one is at and ``cursor`` its column; ``divergences``
    are columns; times count from ``base_ns``. What is said in words hides marks, but not all.
    """
    window, columns = lanes.window, lanes.columns
    if window.order:
        # The rows of two runs have other numbers than the events in them.
        what = "row" if len({lane.run for lane in lanes.lanes}) > 1 else "event"
        left, right = f"{what} {max(window.start, 0)}", f"{window.end - 1}"
        here = f"▲ {position}"
        scale = f"one column is one {what}"
    else:
        left = f"{format_seconds(window.start - base_ns)[:-6]} s"
        right = f"{format_seconds(window.end - base_ns)[:-6]} s"
        here = f"▲ {format_seconds(position - base_ns)[:-3]} s"
        scale = f"{format_duration(window.step(columns))} per column"
    if lanes.known < 1:
        scale += f", {lanes.known:.0%} read"
    line = [" "] * columns
    for column in divergences:
        _put(line, column, _MARK)
    middle = (columns - len(scale)) // 2
    free = middle > max(len(left), len(right))
    free &= not any(middle - 1 <= column <= middle + len(scale) for column in divergences)
    if free and abs(cursor - columns // 2) > len(scale) // 2 + len(here) + 2:
        _put(line, middle, scale)
    at, here = _here(here, cursor, columns)
    for start, text in ((0, left), (columns - len(right), right)):
        if here and at - 1 < start + len(text) and start < at + len(here) + 1:
            continue
        without = line.copy()
        _put(line, start, text, gap=True)
        if _MARK in without and _MARK not in line:
            line = without
    _put(line, at, here, gap=bool(here))
    return "".join(line)


def _here(text: str, cursor: int, columns: int) -> tuple[int, str]:
    """Return where it says what is at the cursor (``▲ …``), and how: at its right or left."""
    if not 0 <= cursor < columns:
        return 0, ""
    if cursor <= max(columns - len(text), 0):
        return cursor, text
    text = f"{text[2:]} ▲"
    return max(cursor - len(text) + 1, 0), text


def _put(line: list[str], start: int, text: str, *, gap: bool = False) -> None:
    if gap:
        _put(line, start - 1, " ")
        _put(line, start + len(text), " ")
    for offset, character in enumerate(text):
        if 0 <= start + offset < len(line):
            line[start + offset] = character
