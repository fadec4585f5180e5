"""What is open and where one is in it: the state behind the screen, without a screen.

The app changes this object and draws what it says; tests drive it directly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from typing import TYPE_CHECKING

from rsltrace.errors import TraceError
from rsltrace.model.entity import WITH_TOPIC, EntityKind
from rsltrace.model.event import EventKind, OutputKind
from rsltrace.model.stamp import NS_PER_S, format_duration
from rsltrace.trace.native import is_native, refuse_native
from rsltrace.words.times import TimeInRun
from rsltrace_viewer.model.chains import Chain, read_chains
from rsltrace_viewer.model.checks import Checks, read_checks
from rsltrace_viewer.model.history import History, Marks
from rsltrace_viewer.model.inspector.effects import Effects
from rsltrace_viewer.model.inspector.event import inspect
from rsltrace_viewer.model.inspector.lines import Line, Openness
from rsltrace_viewer.model.lane_window import LaneWindow
from rsltrace_viewer.model.lanes import Lanes
from rsltrace_viewer.model.logs import Logs, mark_lanes, read_logs
from rsltrace_viewer.model.overview import Overview, read_overview
from rsltrace_viewer.model.query import conditions
from rsltrace_viewer.model.query.conditions import Condition
from rsltrace_viewer.model.query.parser import parse
from rsltrace_viewer.model.rows import AllRows, FilteredRows, Rows
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.columns import Columns, layout
from rsltrace_viewer.model.timeline.events import EventText, EventTexts, node_of
from rsltrace_viewer.model.timeline.message_values import both_values
from rsltrace_viewer.model.timeline.row_values import RowValues
from rsltrace_viewer.model.timeline.short_names import ShortNames
from rsltrace_viewer.model.view import Sign, SingleView, View

if TYPE_CHECKING:
    from rsltrace.diff.alignment.blocks import AlignedBlock
    from rsltrace_viewer.model.comparison import Comparison
    from rsltrace_viewer.model.plots.runs import RunPlots

SEEK: dict[str, tuple[Condition, str]] = {
    "raised": (conditions.RAISED, "exception"),
    "log": (conditions.ANY_LOG, "log record"),
    "warning": (conditions.log_at_least(30), "warning"),
    "finding": (conditions.GUARD_FINDING, "finding of the guard"),
}
"""What one can jump to by a key: the condition, and what it is called."""


class Session:
    """One run, or two that are compared. ``place`` is the selected row of the whole timeline."""

    def __init__(self, a: Run, b: Run | None = None) -> None:
        self.a = a
        self.b = b
        self.comparison: Comparison | None = None
        self.side = "diff" if b is not None else "a"
        self.view: View = SingleView(a.count)
        if b is not None:
            for run in (a, b):
                refuse_native(run.trace, "its events are at times of their own (see rsltrace diff)")
            from rsltrace_viewer.model.comparison import Comparison

            self.view = self.comparison = Comparison(a, b)
        self.rows: Rows = AllRows(self.view.count)
        self.filter_text = ""
        self.search: Condition | None = None
        self.search_text = ""
        self.place = 0
        if self.comparison is not None:
            self.place = self.comparison.first_place or 0
        self.history = History()
        self.marks = Marks()
        self.openness = Openness()
        self.effects: Effects | None = None
        self.base_ns = a.start_ns if a.since_epoch else 0
        """What times count from: the start of the run, where they would be those since 1970."""
        runs = self.runs
        self._texts = {name: EventTexts(run, self.base_ns) for name, run in runs.items()}
        self.values = {name: RowValues(run) for name, run in runs.items()}
        self._names = self._short_names()
        self.lane_window = LaneWindow([run for run in (a, b) if run is not None])
        self.logs: dict[str, Logs] = {}
        """The log records of each run, once they are read."""
        self.overviews: dict[str, Overview] = {}
        """What is counted of each run so far, once counting was asked for."""
        self.checks: dict[str, Checks] = {}
        """What came of the checks of each run that has some (nothing while that is found out)."""
        self.chains: dict[str, tuple[Chain, ...]] = {}
        """The chains of each run, as far as they are found."""

    @property
    def runs(self) -> dict[str, Run]:
        """The runs by their names, ``a`` and ``b``."""
        return {"a": self.a} if self.b is None else {"a": self.a, "b": self.b}

    def close(self) -> None:
        """Close the files."""
        self.a.close()
        if self.b is not None:
            self.b.close()

    def take_block(self, block: AlignedBlock | None) -> None:
        """Show another block of two runs; the selected event stays selected."""
        comparison = self.comparison
        if comparison is None:
            return
        a, b = comparison.a(self.place), comparison.b(self.place)
        comparison.take(block)
        if a is not None:
            self.place = comparison.place_of(a)
        elif b is not None:
            self.place = comparison.place_of(b, other=True)
        if not self.filter_text:
            self.rows = AllRows(comparison.count)

    def replace_run(self, run: Run) -> None:
        """Show a newer state of the same recording. The old file is closed."""
        old, self.a = self.a, run
        self._texts["a"] = EventTexts(run, self.base_ns)
        self.values["a"] = RowValues(run)
        self._names = self._short_names()
        self.view = SingleView(run.count)
        self.rows = AllRows(run.count)
        self.lane_window.replace_run(run)
        self.logs.clear()
        self.overviews, self.checks, self.chains = (
            {},
            {},
            {},
        )  # others: the old are still filled for a moment
        old.close()

    def next_side(self) -> str:
        """Inspect the differences, run a or run b; return which it is now."""
        if self.b is not None:
            sides = ("diff", "a", "b")
            self.side = sides[(sides.index(self.side) + 1) % 3]
        return self.side

    # What is selected.

    @property
    def empty(self) -> bool:
        """Whether there is no event at all."""
        return self.view.count == 0

    @property
    def nothing(self) -> str:
        """What to say where there is no event at all."""
        if self.a.trace.complete:
            return "no events in this trace"
        return "no events yet: a run writes some four thousand at a time"

    def current(self) -> tuple[Run, int] | None:
        """Return the run and the index of the selected event; None if there is no event."""
        if self.empty:
            return None
        index_a, index_b = self.view.a(self.place), self.view.b(self.place)
        if self.b is not None and index_b is not None and (index_a is None or self.side == "b"):
            return self.b, index_b
        return (self.a, index_a) if index_a is not None else None

    def stamp(self) -> int:
        """Return the time of the selected event (0: none)."""
        here = self.current()
        return here[0].stamp(here[1]) if here else 0

    def row_of_place(self) -> int:
        """Return the row that is, or is next to, the selected place."""
        return self.rows.near(self.place)

    # Rows.

    def columns(self, width: int) -> Columns:
        """Return the columns for a timeline of ``width`` cells."""
        texts = self._texts["a"]
        return layout(
            width,
            index_width=max(t.index_width for t in self._texts.values()),
            time_width=max(t.time_width for t in self._texts.values()),
            node_width=texts.node_width,
            names=self._names,
            signs=self.b is not None,
            deltas=self.comparison is not None and self.comparison.shifted,
            relative=bool(self.base_ns),
        )

    def _short_names(self) -> dict[str, ShortNames]:
        return {
            column: ShortNames(set[str]().union(*(t.names[column] for t in self._texts.values())))
            for column in ("node", "entity")
        }

    def row(self, row: int) -> tuple[EventText, Sign | None, bool, str]:
        """Return the event of a row in words, its sign, whether it is marked, its relation."""
        place = self.rows.at(row)
        index, index_b = self.view.a(place), self.view.b(place)
        if index is not None:
            event = self._with_values("a", index)
            if index_b is not None:
                event = self._with_other(event, place, index, index_b)
        else:
            assert index_b is not None  # a place stands for something
            event = self._with_values("b", index_b)
        return event, self.view.sign(place), place in self.marks, self._relation(place)

    def _with_values(self, name: str, index: int) -> EventText:
        return self.values[name].known(self._texts[name].of(index))

    def _with_other(self, event: EventText, place: int, index: int, index_b: int) -> EventText:
        """Return an event of run a with what is to be said of that of run b beside it."""
        assert self.b is not None  # there is an event of it
        if not event.raised:
            other = self._texts["b"].of(index_b)
            if other.raised:  # what run a did here is not what one looks for
                outputs = f"b: {other.outputs}; a: {event.outputs or 'nothing'}"
                event = replace(event, raised=True, outputs=outputs)
            elif self.view.sign(place) is Sign.DIFFERS:
                values = self._with_values("b", index_b).outputs
                event = replace(event, outputs=both_values(event.outputs, values))
        later_ns = self.b.stamp(index_b) - self.a.stamp(index)
        return replace(event, delta=_short_duration(later_ns)) if later_ns else event

    def read_values(self, rows: Sequence[int]) -> Iterator[int]:
        """Read the values of some rows, a row at a time."""
        places = [self.rows.at(row) for row in rows if row < self.rows.count]
        found = [(self.view.a(place), self.view.b(place)) for place in places]
        yield from self.values["a"].read([a for a, _ in found if a is not None])
        if self.b is not None:
            differs = {place for place in places if self.view.sign(place) is Sign.DIFFERS}
            pairs = zip(places, found, strict=True)
            of_b = [b for place, (a, b) in pairs if a is None or place in differs]
            yield from self.values["b"].read([b for b in of_b if b is not None])

    def _relation(self, place: int) -> str:
        """Return ``cause`` or ``effect`` if that is what the event is to the selected one."""
        here = self.current()
        if here is None or place == self.place:
            return ""
        run, index = here
        other = self.view.b(place) if run is self.b else self.view.a(place)
        if other is None:
            return ""
        if int(run.row(index)["cause_event"]) == other:
            return "cause"
        if self.effects is not None and self.effects.event == index:
            return "effect" if other in self.effects.found else ""
        return ""

    def lines(self) -> list[Line]:
        """Return the lines of the inspector."""
        here = self.current()
        if here is None:
            return []
        if self.comparison is not None and self.side == "diff":
            from rsltrace_viewer.model.inspector.differences import pair_lines

            return pair_lines(self.comparison, self.place, self.openness, self.effects)
        return inspect(here[0], here[1], self.openness, self.effects)

    # Lanes.

    def lanes(self, columns: int) -> tuple[Lanes, int]:
        """Return the lanes, and where the cursor is in them (a time, or a place)."""
        made = self.lane_window.lanes(self.view, self.place, self._in_lanes(), columns)
        return made, self.place if made.window.order else self.stamp()

    def zoom(self, step: int, columns: int) -> None:
        """Zoom the lanes in (1), out (-1), or to the whole run (0)."""
        self.lane_window.zoom(step, self._in_lanes(), columns)

    def look_through(self) -> Iterator[int]:
        """Read, a bit at a time, what the lanes need: how busy nodes are, and what went wrong."""
        for maker in self.lane_window.makers:
            for number in maker.order():
                maker.summarise(number)
                yield number
        for (name, run), maker in zip(self.runs.items(), self.lane_window.makers, strict=True):
            logs = Logs([])
            for logs in read_logs(run):
                yield len(logs.lines)
            yield from mark_lanes(run, maker, logs)
            self.logs[name] = logs

    def survey(self) -> Iterator[float]:
        """Count each run for its overview, a segment at a time, hold its checks against it and
        find its chains;
        nothing if that is done, or under way. The lanes are filled on the way. Yields the part of
        a run that is read."""
        if self.overviews:
            return iter(())
        self.overviews.update((name, Overview()) for name in self.runs)
        return self._survey(self.overviews, self.checks, self.chains)

    def _survey(
        self,
        overviews: dict[str, Overview],
        checks: dict[str, Checks],
        chains: dict[str, tuple[Chain, ...]],
    ) -> Iterator[float]:
        for (name, run), maker in zip(self.runs.items(), self.lane_window.makers, strict=True):
            for number, overviews[name] in enumerate(read_overview(run)):
                if number < len(run.segments):
                    maker.summarise(number)
                yield overviews[name].share
        for name, run in self.runs.items():
            for checks[name] in read_checks(run):
                yield 1.0
        for name, run in self.runs.items():
            for chains[name] in read_chains(run):
                yield 1.0

    def _in_lanes(self) -> tuple[int, int] | None:
        here = self.current()
        return None if here is None else (int(here[0] is self.b), here[1])

    def own_lane(self) -> str:
        """Return the node of the selected event."""
        here = self.current()
        if here is None:
            return ""
        try:
            return node_of(here[0], here[0].event(here[1]))
        except TraceError:
            return ""

    # Finding.

    def same(self, what: str) -> tuple[Condition, str] | None:
        """Return the condition of ``node``, ``entity`` or ``topic`` being that of the selected
        event, and its name; None if it has none."""
        here = self.current()
        if here is None:
            return None
        run, index = here
        try:
            event, outputs = run.event(index), run.outputs(index)
        except TraceError:
            return None
        entity = run.entities.get(event.entity)
        if event.kind is EventKind.CONSTRUCT:
            made = next((o for o in outputs if o.kind is OutputKind.ENTITY), None)
            entity = run.entities.get(made.entity) if made is not None else entity
        if entity is None:
            return None
        if what == "node":
            return conditions.of_nodes(run, frozenset((entity.node,))), run.node_name(entity.id)
        if what == "entity":
            return conditions.OfEntities(conditions.ids([entity.id])), run.entity_name(entity.id)
        topic = entity.name if entity.kind in WITH_TOPIC else ""
        if not topic:
            sent = next((o for o in outputs if o.kind is OutputKind.MESSAGE), None)
            topic = run.entity_name(sent.entity) if sent is not None else ""
        if not topic:
            return None
        return conditions.OfEntities(conditions.ids(run.ids_on(topic)), outputs=True), topic

    def seek(self, condition: Condition, step: int, *, wrap: bool = False) -> Iterator[int | None]:
        """Yield None while looking and the places of matches from the selected one on."""
        here = self.current()
        if here is None:
            return
        run, index = here
        other = run is self.b
        for found in conditions.find(run, condition, index, step):
            yield None if found is None else self.view.place_of(found, other=other)
        if wrap:
            start = -1 if step > 0 else run.count
            for found in conditions.find(run, condition, start, step):
                yield None if found is None else self.view.place_of(found, other=other)

    def set_filter(self, text: str) -> FilteredRows | None:
        """Show only events that fulfil a filter (empty: all). Raises QueryError.

        Returns the rows to be found by ``advance``; None if there is no filter.
        """
        condition = parse(text, self.a)
        self.filter_text = text.strip()
        if condition is None:
            self.rows = AllRows(self.view.count)
            return None
        rows = FilteredRows(self.a, condition, self.view)
        self.rows = rows
        return rows

    def set_search(self, text: str) -> None:
        """Set what ``n`` looks for (empty: nothing). Raises QueryError."""
        self.search = parse(text, self.a)
        self.search_text = text.strip()

    # Going somewhere.

    def go(self, place: int, *, remember: bool = True) -> None:
        """Select a place, and remember where one was."""
        if remember and place != self.place:
            self.history.leave(self.place)
        self.place = max(min(place, self.view.count - 1), 0)
        self.effects = None

    def place_at_time(self, time: TimeInRun) -> int:
        """Return the place of the first event at a time or later."""
        return self.view.place_of(self.a.index_at(time.stamp_ns(self.a.trace.start_ns)))

    # Words.

    def plots(self) -> RunPlots:
        """Return what can be plotted."""
        from rsltrace_viewer.model.plots.runs import RunPlots

        found = self.same("topic")
        return RunPlots(
            [run for run in (self.a, self.b) if run is not None],
            self.title(),
            topic=found[1] if found is not None else "",
            stamp_ns=None if self.empty else self.stamp(),
            base_ns=self.base_ns,
            diff=self.comparison.diff if self.comparison is not None else None,
            chains=[one.name for found in self.chains.values() for one in found],
        )

    def mode(self) -> str:
        """Return what is shown of it: one run, or of two which."""
        if self.b is None:
            return "one run"
        return {"diff": "differences of a and b", "a": "run a of a, b", "b": "run b of a, b"}[
            self.side
        ]

    def title(self) -> str:
        """Return the name of what is open."""
        return self.a.name if self.b is None else f"{self.a.name} ↔ {self.b.name}"

    def facts(self) -> str:
        """Return a line of facts about it."""
        trace = self.a.trace
        parts = [f"{self.a.count:,} event{'' if self.a.count == 1 else 's'}"]
        if self.b is not None and self.b.count != self.a.count:
            parts[0] = f"{self.a.count:,} and {self.b.count:,} events"
        # What is wrong comes early: little fits into a narrow terminal.
        unfinished = [r.name for r in (self.a, self.b) if r is not None and not r.trace.complete]
        if unfinished:
            parts.append("not finished" if self.b is None else f"{unfinished[0]} is not finished")
        reason = trace.result.get("exit_code", "0")
        if self.b is None and reason != "0":
            parts.append(f"exit code {reason}")
        how = "of real time" if is_native(trace) else "simulated"
        parts.append(f"{format_duration(self.a.end_ns - self.a.start_ns)} {how}")
        if self.base_ns:
            began = datetime.fromtimestamp(self.base_ns // NS_PER_S, tz=timezone.utc)
            parts.append(f"from {began:%Y-%m-%d %H:%M:%S} UTC")
        nodes = sum(1 for e in self.a.entities.values() if e.kind is EntityKind.NODE)
        parts.append(f"{nodes} node{'' if nodes == 1 else 's'}")
        if self.b is None:
            parts.append("native" if is_native(trace) else f"digest {trace.digest}")
        return "  ".join(parts)


def _short_duration(duration_ns: int) -> str:
    """Return a duration in three digits, with its sign: ``+1.5 ms``."""
    for unit, scale in (("s", NS_PER_S), ("ms", 1_000_000), ("us", 1_000)):
        if abs(duration_ns) >= scale:
            return f"{duration_ns / scale:+.3g} {unit}"
    return f"{duration_ns:+d} ns"
