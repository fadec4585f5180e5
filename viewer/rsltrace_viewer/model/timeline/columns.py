"""The columns of the event list: what each says of an event, and which fit into a width.

To add a column, add a line to ``COLUMNS``. What it says comes from an ``EventText``; a value that
this has not yet is a field there (``events.py``).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import field
from itertools import takewhile

from rich.cells import set_cell_size

from rsltrace.diff.row_sign import RowSign
from rsltrace.fast_dataclass import dataclass
from rsltrace_viewer.model.timeline.events import EventText
from rsltrace_viewer.model.view import cells, fit

GAP = 1
"""Cells between columns."""


@dataclass(frozen=True, slots=True)
class EventRow:
    """A row of the event list: the event, how it compares with the other run, and its marks."""

    event: EventText
    sign: RowSign | None = None
    marked: bool = False
    related: str = ""
    """``cause`` or ``effect`` of the selected event."""

    @property
    def mark(self) -> str:
        """The sign of what deserves attention: ``!`` exception, ``*`` marked, ``w`` warning."""
        event = self.event
        return "!" if event.raised else "*" if self.marked else "w" if event.warns else " "


@dataclass(frozen=True, slots=True)
class ListSpace:
    """What the widths of columns depend on: the width of the list, and of its longest values."""

    width: int
    index_width: int
    time_width: int
    node_width: int
    signs: bool = False
    """Whether rows show how two runs compare."""
    two: bool = False
    """Whether rows show the events of two runs."""
    deltas: bool = False
    """Whether the runs have times that differ."""
    relative: bool = False
    """Whether times count from the start of the run."""

    @property
    def narrow(self) -> bool:
        """Whether times are shown to the microsecond (cut, not rounded) for want of space."""
        return self.width < 90

    @property
    def share(self) -> int:
        """Cells of a column of names."""
        return self.width // (8 if self.narrow else 6)


@dataclass(frozen=True, slots=True)
class EventColumn:
    """A column of the event list.

    ``width`` returns its cells, 0 to leave it out, ``_REST`` for all that is left. It is shown if
    it leaves ``spare`` cells for the columns after it (None: always): the widths of those that
    must not be lost. ``style`` names the style of
    its cells in ``terminal/widgets/timeline.py``.
    """

    name: str
    title: str
    width: Callable[[ListSpace], int]
    text: Callable[[EventRow, ListSpace], str]
    style: str = "plain"
    right: bool = False
    spare: int | None = 0


_REST = -1


def _time(row: EventRow, space: ListSpace) -> str:
    return row.event.time[:-3] if space.narrow else row.event.time


def _time_width(space: ListSpace) -> int:
    width = space.time_width - 3 if space.narrow else space.time_width
    return max(width, 11 if space.relative else 6)


def _outputs(row: EventRow, space: ListSpace) -> str:
    event = row.event
    return f"{event.delta}  {event.outputs}" if event.delta and space.narrow else event.outputs


COLUMNS = (
    EventColumn(
        "sign",
        "",
        width=lambda space: int(space.signs),
        text=lambda row, _: row.sign.value if row.sign is not None else " ",
        style="sign",
        spare=None,
    ),
    EventColumn(
        "mark",
        "",
        width=lambda _: 1,
        text=lambda row, _: row.mark,
        style="mark",
        spare=None,
    ),
    EventColumn(
        "index",
        "event",
        width=lambda space: 0 if space.two else space.index_width,
        text=lambda row, _: str(row.event.index),
        style="sign",
        right=True,
        spare=None,
    ),
    EventColumn(
        "a",
        "a",
        width=lambda space: space.index_width if space.two else 0,
        text=lambda row, _: row.event.numbers[0],
        style="sign",
        right=True,
        spare=None,
    ),
    EventColumn(
        "b",
        "b",
        width=lambda space: space.index_width if space.two else 0,
        text=lambda row, _: row.event.numbers[1],
        style="sign",
        right=True,
        spare=None,
    ),
    EventColumn("time", "time s", width=_time_width, text=_time, style="time", right=True),
    EventColumn(
        "delta",
        "b − a",
        width=lambda space: 8 if space.two and space.deltas and not space.narrow else 0,
        text=lambda row, _: row.event.delta,
        right=True,
    ),
    EventColumn(
        "node",
        "node",
        width=lambda space: min(space.node_width, max(8, space.share)),
        text=lambda row, _: row.event.node,
        style="node",
    ),
    EventColumn(
        "kind",
        "kind",
        width=lambda _: 6,
        text=lambda row, _: row.event.kind,
        style="muted",
        spare=6,
    ),
    EventColumn(
        "entity",
        "entity",
        width=lambda space: max(10, min(22, space.share)),
        text=lambda row, _: row.event.entity,
    ),
    EventColumn(
        "input",
        "in",
        width=lambda space: 0 if space.two else 6,
        text=lambda row, _: row.event.input_hash,
        style="hash",
        spare=51,
    ),
    EventColumn(
        "output",
        "out",
        width=lambda space: 0 if space.two else 6,
        text=lambda row, _: row.event.output_hash,
        style="hash",
        spare=44,
    ),
    EventColumn(
        "outputs", "what it did", width=lambda _: _REST, text=_outputs, style="outputs", spare=None
    ),
)
"""All columns, in order. Those that do not fit are left out."""


@dataclass(frozen=True, slots=True)
class ColumnLayout:
    """The columns that fit into a list, each with its width in cells."""

    space: ListSpace = field(default_factory=lambda: ListSpace(0, 0, 0, 0))
    columns: tuple[tuple[EventColumn, int], ...] = ()
    names: Mapping[str, ShortNames] = field(default_factory=dict, compare=False)
    """By column, the names that may stand there: they are cut so that they stay distinct."""
    colours: Mapping[str, int] = field(default_factory=dict, compare=False)
    """By node, its place in ``NODE_COLOURS``."""

    def header(self) -> str:
        return " " * GAP + (" " * GAP).join(
            fit(self._title(column), width, right=column.right) for column, width in self.columns
        )

    def _title(self, column: EventColumn) -> str:
        return "since start" if column.name == "time" and self.space.relative else column.title

    def cells(self, row: EventRow) -> list[tuple[EventColumn, str]]:
        """Return the columns with their texts of this row, each in its exact width."""
        return [(column, self._text(column, width, row)) for column, width in self.columns]

    def _text(self, column: EventColumn, width: int, row: EventRow) -> str:
        text = column.text(row, self.space)
        if column.name in self.names:
            return self.names[column.name].fit(text, width)
        if column.name == "outputs" and row.event.short and cells(text) > width:
            text = row.event.short
        return fit(text, width, right=column.right)


def layout(space: ListSpace, names: Mapping[str, ShortNames]) -> ColumnLayout:
    """Return the columns that fit into a list. Narrow lists lose what is needed least."""
    left = space.width - GAP
    chosen = []
    is_full = False
    for column in COLUMNS:
        width = column.width(space)
        if width == _REST:
            width = left - GAP if left > 3 else 0
        if not width:
            continue
        if column.spare is not None:  # what follows one that does not fit is needed even less
            is_full = is_full or left - width - GAP < column.spare
            if is_full:
                continue
        chosen.append((column, width))
        left -= width + GAP
    return ColumnLayout(space, tuple(chosen), names)


# A set of names often shares a namespace at the beginning and a kind of sensor at the end. Cut at
# the end they may all look the same. So each is cut where it leaves a form that fewest others have.


class ShortNames:
    """Cuts the names of a set to a width so that they still differ."""

    def __init__(self, names: Iterable[str]) -> None:
        self._names = sorted(set(names))
        self._by_width: dict[int, dict[str, str]] = {}

    def fit(self, name: str, width: int) -> str:
        """Return ``name`` in exactly ``width`` cells. One that is not in the set is cut as text."""
        if width <= 0 or cells(name) <= width:
            return fit(name, width)
        known = self._by_width.get(width)
        if known is None:
            known = self._by_width[width] = self._cut(width)
        return known.get(name) or fit(name, width)

    def _cut(self, width: int) -> dict[str, str]:
        """Return the cut form of all names that are longer than ``width``."""
        chosen: dict[str, str] = {}
        alike: dict[str, int] = {}
        for cut in (fit, _in_the_middle, _at_the_start, self._where_it_differs):
            forms = {name: cut(name, width) for name in self._names}
            count = Counter(forms.values())
            for name, form in forms.items():
                if cells(name) > width and count[form] < alike.get(name, len(forms) + 1):
                    chosen[name], alike[name] = form, count[form]
        return chosen

    def _where_it_differs(self, name: str, width: int) -> str:
        """Show where the name begins to differ from those before and after it."""
        at = self._names.index(name)
        beside = self._names[max(at - 1, 0) : at] + self._names[at + 1 : at + 2]
        begin = max((_alike(name, other) for other in beside), default=0) - width // 3
        return fit("…" + name[begin:] if begin > 0 else name, width)


def _alike(a: str, b: str) -> int:
    """Return how many characters two names begin with in common."""
    return sum(1 for _ in takewhile(lambda both: both[0] == both[1], zip(a, b, strict=False)))


def _in_the_middle(name: str, width: int) -> str:
    if cells(name) <= width:
        return fit(name, width)
    tail = _tail(name, width // 2)
    return set_cell_size(name, width - 1 - cells(tail)) + "…" + tail


def _at_the_start(name: str, width: int) -> str:
    if cells(name) <= width:
        return fit(name, width)
    tail = _tail(name, width - 1)
    return "…" + tail + " " * (width - 1 - cells(tail))


def _tail(name: str, width: int) -> str:
    """Return the longest end of ``name`` that takes at most ``width`` cells."""
    start = max(len(name) - width, 0)
    while cells(name[start:]) > width:
        start += 1
    return name[start:]
