"""Rows of the timeline: which columns fit into a width, and what each row says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import lru_cache

from rsltrace.errors import TraceError
from rsltrace.model.event import Event, EventFlag, EventKind, OutputKind
from rsltrace.model.printable import printable
from rsltrace.model.stamp import format_seconds
from rsltrace_viewer.model.cells import fit
from rsltrace_viewer.model.names import ShortNames
from rsltrace_viewer.model.run import KIND_WORDS, Run
from rsltrace_viewer.model.text import LEVEL_WARN, log_of, outputs_text

_ROWS_KEPT = 2048
_NODE_WIDTH_MAX = 28
GAP = 1
"""Cells between columns."""


class Sign(Enum):
    """How a row of two traces compares. The value is what is printed, so no colour is needed."""

    MATCH = "="
    DIFFERS = "≠"
    ONLY_A = "-"
    ONLY_B = "+"
    MOVED = "~"
    """Both runs did the same, at another place in the order or at another time."""
    UNKNOWN = "?"
    """Beyond the part of the runs that was aligned."""


@dataclass(frozen=True, slots=True)
class EventText:
    """One event in words, each at its full length."""

    index: int
    time: str
    node: str
    kind: str
    entity: str
    input_hash: str
    output_hash: str
    outputs: str
    raised: bool
    suspended: bool
    warns: bool
    """Whether it logged a warning or worse."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its name, its width in cells, whether it is aligned to the right."""

    name: str
    width: int
    right: bool = False


@dataclass(frozen=True, slots=True)
class Columns:
    """The columns that fit into ``width`` cells, in order."""

    width: int
    columns: tuple[Column, ...] = field(default=())
    micros: bool = False
    """Whether times are shown to the microsecond (cut, not rounded) for want of room."""
    names: Mapping[str, ShortNames] = field(default_factory=dict, compare=False)
    """By column, the names that may stand there: they are cut so that they stay distinct."""

    def header(self) -> str:
        """Return the line of titles."""
        return " " * GAP + (" " * GAP).join(
            fit(_TITLES.get(c.name, c.name), c.width, right=c.right) for c in self.columns
        )

    def cells(self, event: EventText, *, sign: str = " ", mark: str = " ") -> list[tuple[str, str]]:
        """Return (column name, text of its exact width) of a row."""
        values: Mapping[str, str] = {
            "sign": sign,
            "mark": mark,
            "index": str(event.index),
            "time": event.time[:-3] if self.micros else event.time,
            "node": event.node,
            "kind": event.kind,
            "entity": event.entity,
            "input": event.input_hash,
            "output": event.output_hash,
            "outputs": event.outputs,
        }
        return [(c.name, self._fit(values[c.name], c)) for c in self.columns]

    def _fit(self, text: str, column: Column) -> str:
        if column.name in self.names:
            return self.names[column.name].fit(text, column.width)
        return fit(text, column.width, right=column.right)


_TITLES = {
    "sign": "",
    "mark": "",
    "index": "event",
    "time": "time s",
    "entity": "entity",
    "input": "in",
    "output": "out",
    "outputs": "what it did",
}


class EventTexts:
    """Events of a run in words; what was shown last is kept."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self.of = lru_cache(maxsize=_ROWS_KEPT)(self._of)
        self.index_width = max(len(str(max(run.count - 1, 0))), 5)
        self.time_width = len(format_seconds(run.end_ns))
        names = [run.node_name(e.id) for e in run.entities.values()]
        self.node_width = min(max(map(len, names), default=5), _NODE_WIDTH_MAX)
        entities = (_short(run.entity_name(e.id)) for e in run.entities.values())
        self.names = {"node": set(names), "entity": set(entities)}
        """What may stand in these columns."""

    def _of(self, index: int) -> EventText:
        """Return event ``index`` in words. Raises IndexError; damage is written into the row."""
        try:
            return self._readable(index)
        except TraceError as error:
            why = printable(f"unreadable: {error}")
            return EventText(index, "", "", "", "", "", "", why, True, False, False)

    def _readable(self, index: int) -> EventText:
        run = self._run
        event = run.event(index)
        outputs = run.outputs(index) if event.outputs else []
        logs = [log_of(run, output) for output in outputs if output.kind is OutputKind.LOG]
        return EventText(
            index=index,
            time=format_seconds(event.stamp_ns),
            node=node_of(run, event),
            kind=KIND_WORDS[event.kind],
            entity=entity_of(run, event),
            input_hash=f"{event.input_hash:016x}"[:6] if event.input_hash else "·",
            output_hash=f"{event.output_hash:016x}"[:6] if event.output_hash else "·",
            outputs=outputs_text(run, outputs),
            raised=EventFlag.RAISED in event.flags,
            suspended=EventFlag.SUSPENDED in event.flags,
            warns=any(log is not None and log.level >= LEVEL_WARN for log in logs),
        )


def node_of(run: Run, event: Event) -> str:
    """Return the node of an event; the node that a constructor made."""
    if event.kind is EventKind.CONSTRUCT:
        for output in run.outputs(event.index):
            if output.kind is OutputKind.ENTITY:
                return run.node_name(output.entity)
    return run.node_name(event.entity)


def entity_of(run: Run, event: Event) -> str:
    """Return the name of what ran, without what the kind says already."""
    if event.entity == 0:
        return "constructor" if event.kind is EventKind.CONSTRUCT else ""
    return _short(run.entity_name(event.entity))


def _short(name: str) -> str:
    # Timers are named after their callback: `Class._on_timer`. The node says the class.
    return name.rpartition(".")[2] if "." in name and not name.startswith("/") else name


def layout(
    width: int,
    *,
    index_width: int,
    time_width: int,
    node_width: int,
    names: Mapping[str, ShortNames],
    signs: bool = False,
) -> Columns:
    """Return the columns for a timeline of ``width`` cells. Narrow ones lose the least needed."""
    wanted = [Column("sign", 1)] if signs else []
    wanted += [Column("mark", 1), Column("index", index_width, right=True)]
    spare = width - sum(c.width + GAP for c in wanted) - GAP
    micros = width < 90
    time = max(time_width - 3 if micros else time_width, 6)
    node = min(node_width, max(8, width // 6))
    for column, least in (
        (Column("time", time, right=True), 0),
        (Column("node", node), 0),
        (Column("kind", 6), 6),
        (Column("entity", max(10, min(26, width // 5))), 0),
    ):
        if spare - column.width - GAP < least:
            break
        wanted.append(column)
        spare -= column.width + GAP
    if spare >= 14 + 24:
        wanted += [Column("input", 6), Column("output", 6)]
        spare -= 14
    if spare > 3:
        wanted.append(Column("outputs", spare - GAP))
    return Columns(width, tuple(wanted), micros, names)
