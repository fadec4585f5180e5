"""Events as rows of the timeline: each in words, at its full length."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

from rich.cells import set_cell_size

from rsltrace.errors import TraceError
from rsltrace.trace.model.event import (
    Draw,
    Event,
    EventFlag,
    EventKind,
    Output,
    OutputKind,
    duration_of,
)
from rsltrace.trace.model.texts import format_seconds, printable, shortened
from rsltrace.trace.words.entities import RUN_NAME
from rsltrace.trace.words.kinds import SHORT_KINDS
from rsltrace.trace.words.logs import LEVEL_WARN, log_record
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.view import cells, fit

# Names that are too long for their place, cut so that they can still be told from each other.
#
# Names on a robot share much: a namespace at the beginning, a kind of sensor at the end. Cut at
# the end they may all look the same, so the cut is made where it leaves a name that no other one
# has.

_Cut = Callable[[str, int], str]


class ShortNames:
    """A set of names, and how each is written in so many cells."""

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
        for cut in (fit, _in_the_middle, _at_the_start):
            forms = {name: cut(name, width) for name in self._names}
            count = Counter(forms.values())
            for name, form in forms.items():
                if cells(name) > width and name not in chosen and count[form] == 1:
                    chosen[name] = form
        return chosen


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


_ROWS_KEPT = 2048
_SUMMARY_MAX = 400
_NODE_WIDTH_MAX = 28


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
    delta: str = ""
    """How much later it happened in run b, if not at the same time."""
    short: str = ""
    """Of two runs, what to say instead of ``outputs`` where there is no room for that."""
    numbers: tuple[str, str] = ("", "")
    """Of two runs, its number in a and in b, as far as it stands in the row."""


class EventTexts:
    """Events of a run in words; what was shown last is kept. Times count from ``base_ns`` on."""

    def __init__(self, run: Run, base_ns: int = 0) -> None:
        self._run = run
        self._base_ns = base_ns
        self.of = lru_cache(maxsize=_ROWS_KEPT)(self._of)
        self.index_width = max(len(str(max(run.count - 1, 0))), 5)
        self.time_width = len(format_seconds(run.end_ns - base_ns))
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
        logs = [
            log_record(run.trace, output) for output in outputs if output.kind is OutputKind.LOG
        ]
        return EventText(
            index=index,
            time=format_seconds(event.stamp_ns - self._base_ns),
            node=node_of(run, event),
            kind=SHORT_KINDS[event.kind],
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
    outputs = run.outputs(event.index) if event.kind is EventKind.CONSTRUCT else ()
    return run.words.node(event, outputs) or RUN_NAME


def entity_of(run: Run, event: Event) -> str:
    """Return the name of what ran, without what the kind says already."""
    if event.entity == 0:
        return "constructor" if event.kind is EventKind.CONSTRUCT else ""
    return _short(run.entity_name(event.entity))


def _short(name: str) -> str:
    # Timers are named after their callback: `Class._on_timer`. The node says the class.
    return name.rpartition(".")[2] if "." in name and not name.startswith("/") else name


def event_text(run: Run, event: Event) -> str:
    """Return an event in a few words: ``17  /ekf sub /odom``."""
    kind = SHORT_KINDS[event.kind]
    return f"{event.index}  {node_of(run, event)} {kind} {entity_of(run, event)}".rstrip()


def _is_execution_time(output: Output) -> bool:
    is_draw = output.kind is OutputKind.DRAW
    return is_draw and duration_of(output.hash, Draw.EXECUTION) is not None


def outputs_text(
    run: Run,
    outputs: Sequence[Output],
    width: int = _SUMMARY_MAX,
    more: Callable[[Output], str] = lambda output: "",
) -> str:
    """Return what an event did as one line; ``more`` gives what else to say of an output."""
    parts: list[str] = []
    length = 0
    # How long a callback took says least of what it did.
    ordered = sorted(outputs, key=_is_execution_time)
    for text in run.words.outputs(ordered, more):
        parts.append(text)
        length += len(text)
        if length > width:
            break
    return shortened(", ".join(parts), width)


# Columns of the timeline: which fit into a width, and an event cut to them.

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
