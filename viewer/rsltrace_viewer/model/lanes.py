"""The lanes of the nodes of one or two runs: bars over time, or a letter for each event."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from rsltrace.trace.model.event import EventKind
from rsltrace.trace.words.entities import RUN_NAME
from rsltrace_viewer.model.steady import Floats
from rsltrace_viewer.model.windows import Window

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
