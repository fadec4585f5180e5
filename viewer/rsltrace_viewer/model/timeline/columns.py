"""Columns of the timeline: which fit into a width, and an event cut to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rsltrace_viewer.model.cells import cells, fit
from rsltrace_viewer.model.timeline.events import EventText
from rsltrace_viewer.model.timeline.short_names import ShortNames

GAP = 1
"""Cells between columns."""
_DELTA = 8


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
    relative: bool = False
    """Whether times count from the start of the run."""
    names: Mapping[str, ShortNames] = field(default_factory=dict, compare=False)
    """By column, the names that may stand there: they are cut so that they stay distinct."""

    def header(self) -> str:
        """Return the line of titles."""
        return " " * GAP + (" " * GAP).join(
            fit(self._title(c.name), c.width, right=c.right) for c in self.columns
        )

    def _title(self, name: str) -> str:
        return "since start" if name == "time" and self.relative else _TITLES.get(name, name)

    def cells(self, event: EventText, *, sign: str = " ", mark: str = " ") -> list[tuple[str, str]]:
        """Return (column name, text of its exact width) of a row."""
        values: Mapping[str, str] = {
            "sign": sign,
            "mark": mark,
            "index": str(event.index),
            "a": event.numbers[0],
            "b": event.numbers[1],
            "time": event.time[:-3] if self.micros else event.time,
            "delta": event.delta,
            "node": event.node,
            "kind": event.kind,
            "entity": event.entity,
            "input": event.input_hash,
            "output": event.output_hash,
            "outputs": event.outputs,
        }
        return [(c.name, self._fit(self._text(c, values, event), c)) for c in self.columns]

    def _text(self, column: Column, values: Mapping[str, str], event: EventText) -> str:
        text = values[column.name]
        if column.name != "outputs":
            return text
        if event.delta and not any(one.name == "delta" for one in self.columns):
            text = f"{event.delta}  {text}"
        return event.short if event.short and cells(text) > column.width else text

    def _fit(self, text: str, column: Column) -> str:
        if column.name in self.names:
            return self.names[column.name].fit(text, column.width)
        return fit(text, column.width, right=column.right)


_TITLES = {
    "sign": "",
    "mark": "",
    "index": "event",
    "time": "time s",
    "delta": "b − a",
    "entity": "entity",
    "input": "in",
    "output": "out",
    "outputs": "what it did",
}


def layout(
    width: int,
    *,
    index_width: int,
    time_width: int,
    node_width: int,
    names: Mapping[str, ShortNames],
    signs: bool = False,
    two: bool = False,
    deltas: bool = False,
    relative: bool = False,
) -> Columns:
    """Return the columns for a timeline of ``width`` cells. Narrow ones lose the least needed.

    ``signs``: how rows compare; ``two``: the numbers of both runs."""
    wanted = [Column("sign", 1)] if signs else []
    wanted += [Column("mark", 1)]
    wanted += [
        Column(name, index_width, right=True) for name in (("a", "b") if two else ("index",))
    ]
    spare = width - sum(c.width + GAP for c in wanted) - GAP
    micros = width < 90
    time = max(time_width - 3 if micros else time_width, 11 if relative else 6)
    share = 8 if two and micros else 6
    node = min(node_width, max(8, width // share))
    for column, least in (
        (Column("time", time, right=True), 0),
        *(((Column("delta", _DELTA, right=True), 0),) if deltas and not micros else ()),
        (Column("node", node), 0),
        (Column("kind", 6), 6),
        (Column("entity", max(10, min(22, width // share))), 0),
    ):
        if spare - column.width - GAP < least:
            break
        wanted.append(column)
        spare -= column.width + GAP
    if spare >= 14 + 44 and not two:  # in which two may differ
        wanted += [Column("input", 6), Column("output", 6)]
        spare -= 14
    if spare > 3:
        wanted.append(Column("outputs", spare - GAP))
    return Columns(width, tuple(wanted), micros, relative, names)
