"""The lanes of the nodes of one or two runs: bars over time, or a letter for each event."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import field

import numpy as np

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.texts import format_duration, format_seconds
from rsltrace.trace.words.entities import RUN_NAME
from rsltrace_viewer.model.view import Floats, Window

LEVELS = 8
"""Heights of a cell; 0 is empty."""

KIND_LETTERS = {
    EventKind.CONSTRUCT: "I",
    EventKind.TIMER: "T",
    EventKind.SUBSCRIPTION: "s",
    EventKind.SERVICE: "V",
    EventKind.CLIENT: "c",
    EventKind.GUARD_CONDITION: "g",
    EventKind.TASK: "t",
    EventKind.RESUME: "r",
    EventKind.QOS_EVENT: "q",
    EventKind.BAG: "B",
    EventKind.SHUTDOWN: "E",
    EventKind.ACTION: "a",
    EventKind.CLOCK_JUMP: "J",
    EventKind.OUTSIDE: "O",
    EventKind.FAULT: "F",
}


@dataclass(frozen=True, slots=True)
class Lane:
    """One node, in run ``run`` (``a``, ``b``; empty with one run). ``levels``: height 0 … LEVELS
    per column; ``letters`` instead where one event is one column; ``signs``: ``!`` for exceptions,
    ``w`` for warnings, ``g`` for findings of the guard, by column."""

    label: str
    levels: tuple[int, ...]
    signs: Mapping[int, str] = field(default_factory=dict)
    letters: str = ""
    run: str = ""


@dataclass(frozen=True, slots=True)
class Lanes:
    """All lanes of a window. ``known`` is the part of its segments that was read, 0 to 1.

    ``cause`` is the column of the event that caused the selected one, where each has its own.
    """

    window: Window
    columns: int
    lanes: tuple[Lane, ...]
    known: float = 1.0
    cause: int | None = None


@dataclass(frozen=True, slots=True)
class Counted:
    """Events of each node of a run in columns, shape (nodes + 1, columns), and signs of each."""

    labels: Sequence[str]
    counts: Floats
    signs: Sequence[Mapping[int, str]]
    known: float = 1.0


@dataclass(frozen=True, slots=True)
class Lettered:
    """A line per node with a letter for the event of each column, and signs of each."""

    labels: Sequence[str]
    lines: Sequence[str]
    signs: Sequence[Mapping[int, str]]


def drawn(window: Window, columns: int, runs: Sequence[tuple[str, Counted]]) -> Lanes:
    """Return the lanes of one or two runs; with two, those of a node stand below each other."""
    most = max((float(np.max(counted.counts, initial=0.0)) for _, counted in runs), default=0.0)
    lanes = []
    for label in dict.fromkeys(label for _, counted in runs for label in counted.labels):
        for name, counted in runs:
            if label not in counted.labels:
                continue
            row = list(counted.labels).index(label)
            own = counted.counts[row]
            if label == RUN_NAME and not own.any():
                continue
            # Roots, rounded up: a busy node must not flatten the others, a single event is seen.
            levels = np.ceil(np.sqrt(own / max(most, 1.0)) * LEVELS - 1e-3).clip(own > 0, LEVELS)
            heights = tuple(levels.astype(np.int64).tolist())
            lanes.append(Lane(label, heights, counted.signs[row], run=name))
    return Lanes(window, columns, tuple(lanes), min(counted.known for _, counted in runs))


def lettered(
    window: Window,
    columns: int,
    runs: Sequence[tuple[str, Lettered]],
    cause: int | None,
) -> Lanes:
    """Return the lanes where each event has a column of its own. ``cause``: the place of the event
    that caused the selected one."""
    lanes = []
    for label in dict.fromkeys(label for _, run in runs for label in run.labels):
        for name, run in runs:
            row = list(run.labels).index(label) if label in run.labels else -1
            if row >= 0 and (label != RUN_NAME or run.lines[row].strip()):
                lanes.append(Lane(label, (), run.signs[row], run.lines[row], name))
    column = None if cause is None else cause - window.start
    if column is not None and not 0 <= column < columns:
        column = None
    return Lanes(window, columns, tuple(lanes), cause=column)


# The line below the lanes: from when to when they go, where one is, and where runs diverge.

_MARK = "≠"


def axis_text(lanes: Lanes, position: int, cursor: int, divergences: Collection[int]) -> str:
    """Return the line, one character per column.

    ``position`` is the time (or place) that one is at and ``cursor`` its column; ``divergences``
    are columns; times count from the start. What is said in words hides marks, but not all.
    """
    window, columns = lanes.window, lanes.columns
    if window.order:
        # The rows of two runs have other numbers than the events in them.
        what = "row" if len({lane.run for lane in lanes.lanes}) > 1 else "event"
        left, right = f"{what} {max(window.start, 0)}", f"{window.end - 1}"
        here = f"▲ {position}"
        scale = f"one column is one {what}"
    else:
        left = f"{format_seconds(window.start)[:-6]} s"
        right = f"{format_seconds(window.end)[:-6]} s"
        here = f"▲ {format_seconds(position)[:-3]} s"
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
