"""What is open and where one is in it: the state behind the screen, without a screen.

The app changes this object and draws what it says; tests drive it directly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

from rsltrace.diff.row_sign import RowSign
from rsltrace.errors import TraceError
from rsltrace.job.values.times import TimeInRun
from rsltrace.trace.model.entity import WITH_TOPIC, EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.model.texts import format_duration
from rsltrace.trace.native import is_native, refuse_native
from rsltrace.trace.words.entities import node_colours
from rsltrace_viewer.model.chains import Chain, read_chains
from rsltrace_viewer.model.folder import Bookmarks, Event, VisitedEvents
from rsltrace_viewer.model.inspector.effects import Effects
from rsltrace_viewer.model.inspector.event import inspect
from rsltrace_viewer.model.inspector.message_tree import Line, Openness
from rsltrace_viewer.model.lane_maker import LaneWindow
from rsltrace_viewer.model.lanes import Lanes
from rsltrace_viewer.model.logs import Logs, mark_lanes, read_logs
from rsltrace_viewer.model.overview import Checks, Overview, read_checks, read_overview
from rsltrace_viewer.model.query import conditions
from rsltrace_viewer.model.query.conditions import EventFilter
from rsltrace_viewer.model.query.parser import parse
from rsltrace_viewer.model.query.tokens import QueryError
from rsltrace_viewer.model.rows import AllRows, FilteredRows, RowList
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.columns import (
    ColumnLayout,
    EventRow,
    ListSpace,
    ShortNames,
    layout,
)
from rsltrace_viewer.model.timeline.events import EventText, EventTexts, node_of
from rsltrace_viewer.model.timeline.message_values import RowValues
from rsltrace_viewer.model.view import OneRun, View

if TYPE_CHECKING:
    from rsltrace.diff.alignment.aligned_rows import AlignedRow
    from rsltrace.diff.traces.aligned_runs import Block
    from rsltrace_viewer.model.callback_question import CallbackQuestion
    from rsltrace_viewer.model.comparison import Comparison, PairValues
    from rsltrace_viewer.model.plots.runs import RunPlots

SEEK: dict[str, tuple[EventFilter, str]] = {
    "raised": (conditions.RAISED, "exception"),
    "log": (conditions.ANY_LOG, "log record"),
    "warning": (conditions.log_at_least(30), "warning"),
    "finding": (conditions.GUARD_FINDING, "finding of the guard"),
}
"""What one can jump to by a key: the condition, and what it is called."""

BOTH, RUN_A, RUN_B = "diff", "a", "b"
"""What is shown of two runs."""

Sought = Mapping[str, EventFilter]
"""By run, what its events have to fulfil: entities have numbers of their own in each."""


class Session:
    """One run, or two that are compared. ``place`` is the selected row of the whole timeline."""

    def __init__(self, a: Run, b: Run | None = None) -> None:
        self.a = a
        self.b = b
        self.comparison: Comparison | None = None
        self._pair_values: PairValues | None = None
        self.side = BOTH if b is not None else RUN_A
        self.view: View = OneRun(a.count)
        if b is not None:
            for run in (a, b):
                refuse_native(run.trace, "its events are at times of their own (see rsltrace diff)")
            from rsltrace_viewer.model.comparison import Comparison, PairValues

            self.view = self.comparison = Comparison(a, b)
            self._pair_values = PairValues(self.comparison.runs)
        self.rows: RowList = AllRows(self.view.count)
        self.filter_text = ""
        self.search: Sought | None = None
        self.search_text = ""
        self.place = 0
        if self.comparison is not None:
            self.place = self.comparison.first_place or 0
        self.history = VisitedEvents()
        self.marks = Bookmarks()
        self.openness = Openness()
        self.effects: Effects | None = None
        runs = self.runs
        self._texts = {name: EventTexts(run) for name, run in runs.items()}
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
        return {"a": self.a} if self.b is None else {"a": self.a, "b": self.b}

    def close(self) -> None:
        self.a.close()
        if self.b is not None:
            self.b.close()

    @property
    def shown(self) -> dict[str, Run]:
        """The runs whose events are rows, by their names."""
        return {name: run for name, run in self.runs.items() if self.view.has(other=name == RUN_B)}

    def take_block(self, block: Block | None) -> None:
        """Align another block of two runs; the selected event stays selected."""
        comparison = self.comparison
        if comparison is None:
            return
        selected = self._events(self.place)
        comparison.runs.take(block)
        for other, index in selected[:1]:
            self.place = self.view.place_of(index, other=other)
        if not self.filter_text:
            self.rows = AllRows(self.view.count)

    def replace_run(self, run: Run) -> None:
        """Show a newer state of the same recording. The old file is closed."""
        old, self.a = self.a, run
        self._texts["a"] = EventTexts(run)
        self.values["a"] = RowValues(run)
        self._names = self._short_names()
        self.__dict__.pop("node_colours", None)
        self.view = OneRun(run.count)
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
        """Show both runs, run a alone or run b alone; return which it is now. The selected event
        stays selected, or the same event in the run that is shown. A filter has to be set anew."""
        if self.comparison is not None:
            sides = (BOTH, RUN_A, RUN_B)
            self._show_side(sides[(sides.index(self.side) + 1) % 3])
        return self.side

    def _show_side(self, side: str) -> None:
        comparison = self.comparison
        assert comparison is not None  # one run has one side
        selected = self._events(self.place)
        self.side = side
        if side == BOTH:
            self.view = comparison
        else:
            other = side == RUN_B
            self.view = OneRun(self.runs[side].count, other=other, aligned=comparison.rows)
        self.rows = AllRows(self.view.count)
        own = [event for event in selected if self.view.has(other=event[0])]
        for event_other, index in (own or selected)[:1]:
            self.place = self.view.place_of(index, other=event_other)
        self.effects = None

    def show_event(self, index: int, *, other: bool) -> int:
        """Return the place of an event of run a (``other``: of run b); show both runs if its own
        is not shown."""
        if not self.view.has(other=other):
            self._show_side(BOTH)
        return self.view.place_of(index, other=other)

    # What is selected.

    @property
    def empty(self) -> bool:
        return self.view.count == 0

    @property
    def nothing(self) -> str:
        if self.a.trace.complete:
            return "no events in this trace"
        return "no events: the run writes some four thousand at a time, or was killed before"

    def _events(self, place: int) -> list[Event]:
        """Return the events at a place, run a's first."""
        if not 0 <= place < self.view.count:
            return []
        found = ((False, self.view.a(place)), (True, self.view.b(place)))
        return [(other, index) for other, index in found if index is not None]

    def current(self) -> tuple[Run, int] | None:
        """Return the run and the index of the selected event (where both runs have it, of run a);
        None if there is no event."""
        for other, index in self._events(self.place):
            run = self.b if other else self.a
            assert run is not None  # it has an event
            return run, index
        return None

    def question(self) -> CallbackQuestion | None:
        """Return what `rsltrace why` is asked about the selected event; where one run lacks it,
        about that run. None: nothing."""
        from rsltrace_viewer.model.callback_question import question_about

        here = self.current()
        if here is None:
            return None
        of_b = here[0] is self.b
        alone = self.view.sign(self.place) in (RowSign.ONLY_A, RowSign.ONLY_B)
        lacking = self.a if of_b else self.b
        return question_about(*here, other=of_b, lacking=lacking if alone else None)

    def stamp(self) -> int:
        """Return the time of the selected event (0: none)."""
        here = self.current()
        return here[0].stamp(here[1]) if here else 0

    def row_of_place(self) -> int:
        """Return the row that is, or is next to, the selected place."""
        return self.rows.near(self.place)

    # Rows.

    def columns(self, width: int) -> ColumnLayout:
        """Return the columns for a timeline of ``width`` cells."""
        texts = [self._texts[name] for name in self.shown]
        two = len(texts) > 1
        space = ListSpace(
            width,
            index_width=_numbers_width(self.shown.values()) if two else texts[0].index_width,
            time_width=max(t.time_width for t in texts),
            node_width=max(t.node_width for t in texts),
            signs=self.b is not None,
            two=two,
            deltas=two and self.comparison is not None and self.comparison.rows.shifted,
            relative=any(run.base_ns for run in self.shown.values()),
        )
        return replace(layout(space, self._names), colours=self.node_colours)

    def _short_names(self) -> dict[str, ShortNames]:
        return {
            column: ShortNames(set[str]().union(*(t.names[column] for t in self._texts.values())))
            for column in ("node", "entity")
        }

    @cached_property
    def node_colours(self) -> dict[str, int]:
        """The colour of each node of the runs, by its name."""
        return node_colours(node.name for run in self.runs.values() for node in run.nodes)

    def row(self, row: int) -> EventRow:
        place = self.rows.at(row)
        events = self._events(place)
        other, index = events[0]
        event = self._with_values(RUN_B if other else RUN_A, index)
        if self.view is self.comparison:
            event = self._of_two(event, self.comparison.row(place), place)
        sign, marked = self.view.sign(place), self.marks.of(events)
        return EventRow(event, sign, marked, self._relation(place))

    def _with_values(self, name: str, index: int) -> EventText:
        return self.values[name].known(self._texts[name].of(index))

    def _of_two(self, event: EventText, row: AlignedRow, place: int) -> EventText:
        """Return the event of an aligned row with what is to be said of the other run."""
        assert self.comparison is not None
        assert self.b is not None
        a, b = row.pair
        text, short, raised = event.outputs, "", event.raised
        if a is not None and b is not None and row.sign is RowSign.DIFFERS:
            text, short, raised = self._differing(a, b)
        elif row.sign in (RowSign.ONLY_A, RowSign.ONLY_B):
            text = f"only in {'a' if row.b is None else 'b'}{text and ': '}{text}"
        delta = ""
        if a is not None and b is not None and (later_ns := self.b.stamp(b) - self.a.stamp(a)):
            delta = format_duration(later_ns, 3, signed=True)
        if row.elsewhere is not None:
            there = self.comparison.place_of(row.elsewhere, other=row.b is None)
            mark = (
                f"{'↓' if there > place else '↑'} {'b' if row.b is None else 'a'} {row.elsewhere}"
            )
            text, short = f"{mark} {text}".rstrip(), f"{mark} {short}" if short else ""
        numbers = ("" if row.a is None else str(row.a), "" if row.b is None else str(row.b))
        return replace(
            event, outputs=text, short=short, raised=raised, delta=delta, numbers=numbers
        )

    def _differing(self, a: int, b: int) -> tuple[str, str, bool]:
        """Return in what two events differ, the same in short, and whether one ended with an
        exception."""
        events = self._with_values(RUN_A, a), self._with_values(RUN_B, b)
        texts = [event.outputs or "nothing" for event in events]
        either = texts[0]
        if texts[0] != texts[1]:  # what ended with an exception comes first
            named = [f"a: {texts[0]}", f"b: {texts[1]}"]
            either = " | ".join(reversed(named) if events[1].raised > events[0].raised else named)
        raised = any(event.raised for event in events)
        if events[0].raised != events[1].raised:
            return either, "", raised
        assert self._pair_values is not None  # there are two runs
        known = self._pair_values.known((a, b))
        if known is None or not known[0]:
            return either, "", raised
        return *known, raised

    def read_values(self, rows: Sequence[int]) -> Iterator[int]:
        """Read the values of some rows, a row at a time."""
        places = [self.rows.at(row) for row in rows if row < self.rows.count]
        own: dict[str, list[int]] = {RUN_A: [], RUN_B: []}
        pairs = []
        for place in places:
            other, index = self._events(place)[0]
            pair = self._pair(place)
            if pair is None:
                own[RUN_B if other else RUN_A].append(index)
            else:
                pairs.append(pair)
        for name, indexes in own.items():
            if indexes:
                yield from self.values[name].read(indexes)
        if self._pair_values is not None:
            for name, side in zip((RUN_A, RUN_B), zip(*pairs, strict=True), strict=False):
                yield from self.values[name].read(side)
            yield from self._pair_values.read(pairs)

    def _pair(self, place: int) -> tuple[int, int] | None:
        """Return the two events that differ at a place, wherever they stand."""
        if self.view is not self.comparison:
            return None
        row = self.comparison.row(place)
        a, b = row.pair
        if row.sign is not RowSign.DIFFERS or a is None or b is None:
            return None
        return a, b

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
        here = self.current()
        if here is None:
            return []
        if self.comparison is not None and self.side == BOTH:
            from rsltrace_viewer.model.inspector.differences import pair_lines

            return pair_lines(self.comparison, self.place, self.openness, self.effects)
        return inspect(here[0], here[1], self.openness, self.effects)

    # Lanes.

    def lanes(self, columns: int) -> tuple[Lanes, int]:
        """Return the lanes, and where the cursor is in them (a time, or a place)."""
        made = self.lane_window.lanes(self.view, self.place, self._in_lanes(), columns)
        here = self.current()
        since_ns = 0 if here is None else here[0].stamp(here[1]) - here[0].base_ns
        return made, self.place if made.window.order else since_ns

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
            self.logs[name] = logs
            yield from mark_lanes(run, maker, logs)

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
        here = self.current()
        if here is None:
            return ""
        try:
            return node_of(here[0], here[0].event(here[1]))
        except TraceError:
            return ""

    # Finding.

    def same(self, what: str) -> tuple[Sought, str] | None:
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
            name = run.node_name(entity.id)
            return {
                key: conditions.of_nodes(
                    one,
                    frozenset(e.node for e in one.entities.values() if one.node_name(e.id) == name),
                )
                for key, one in self.runs.items()
            }, name
        if what == "entity":
            return {
                key: conditions.OfEntities(conditions.ids(self._ids_in(one, run, entity.id)))
                for key, one in self.runs.items()
            }, run.entity_name(entity.id)
        topic = entity.name if entity.kind in WITH_TOPIC else ""
        if not topic:
            sent = next((o for o in outputs if o.kind is OutputKind.MESSAGE), None)
            topic = run.entity_name(sent.entity) if sent is not None else ""
        if not topic:
            return None
        return {
            key: conditions.OfEntities(conditions.ids(one.ids_on(topic)), outputs=True)
            for key, one in self.runs.items()
        }, topic

    def _ids_in(self, run: Run, own: Run, entity: int) -> list[int]:
        """Return the id in a run of an entity of run ``own``, if it is there."""
        if run is own or self.comparison is None:
            return [entity]
        matching = self.comparison.runs.matching
        tables = matching.numbers_a, matching.numbers_b
        mine, theirs = tables if own is self.a else tables[::-1]
        return [int(one) for one in (theirs == mine[entity]).nonzero()[0]]

    def seek(self, sought: Sought, step: int, *, wrap: bool = False) -> Iterator[int | None]:
        """Yield None while looking and the places of matches from the selected one on."""
        if self.empty:
            return
        yield from self._seek_from(self.place, sought, step)
        if wrap:
            yield from self._seek_from(-1 if step > 0 else self.view.count, sought, step)

    def _seek_from(self, start: int, sought: Sought, step: int) -> Iterator[int | None]:
        """Yield what ``seek`` does, from a place on that does not count."""
        walks: list[Iterator[int | None]] = []
        for name, run in self.shown.items():
            if name in sought:
                other = name == RUN_B
                first = self.view.before(start + (step > 0), other=other) - (step > 0)
                found = conditions.find(run, sought[name], first, step)
                walks.append(self._places_of(found, other=other))
        nearest: list[int | None] = [None] * len(walks)
        last = None
        while True:
            for number, walk in enumerate(walks):
                while nearest[number] is None:
                    place = next(walk, -1)
                    if place is None:
                        yield None
                    nearest[number] = place
            there = [place for place in nearest if place is not None and place >= 0]
            if not there:
                return
            best = min(there) if step > 0 else max(there)
            nearest = [None if place == best else place for place in nearest]
            if best != last:  # a row with events of both that match is one match
                yield best
            last = best

    def _places_of(self, found: Iterator[int | None], *, other: bool) -> Iterator[int | None]:
        for index in found:
            yield None if index is None else self.view.place_of(index, other=other)

    @property
    def segments(self) -> int:
        """How many segments there are to look at."""
        return sum(len(run.segments) for run in self.shown.values())

    def parse(self, text: str) -> Sought | None:
        """Return what a filter or search stands for in each run; None if it is empty.

        Raises QueryError, unless it means something in one of two runs.
        """
        found, errors = {}, []
        for name, run in self.runs.items():
            try:
                condition = parse(text, run)
            except QueryError as error:
                errors.append(error)
                continue
            if condition is None:
                return None
            found[name] = condition
        if not found:
            raise errors[0]
        return found

    def set_filter(self, text: str) -> FilteredRows | None:
        """Show only events that fulfil a filter (empty: all), of two runs the rows of events that
        do. Raises QueryError.

        Returns the rows to be found by ``advance``; None if there is no filter.
        """
        sought = self.parse(text)
        self.filter_text = text.strip()
        if sought is None:
            self.rows = AllRows(self.view.count)
            return None
        shown = [
            (run, sought[name], name == RUN_B) for name, run in self.shown.items() if name in sought
        ]
        self.rows = rows = FilteredRows(shown, self.view)
        return rows

    def set_search(self, text: str) -> None:
        """Set what ``n`` looks for (empty: nothing). Raises QueryError."""
        self.search = self.parse(text)
        self.search_text = text.strip()

    # Going somewhere.

    def go(self, place: int, *, remember: bool = True) -> None:
        if remember and place != self.place:
            for event in self._events(self.place)[:1]:
                self.history.leave(event)
        self.place = max(min(place, self.view.count - 1), 0)
        self.effects = None

    def travel(self, step: int) -> int | None:
        """Return the place one came from (-1), or came back from (1); None if there is none."""
        for event in self._events(self.place)[:1]:
            move = self.history.forward if step > 0 else self.history.back
            found = move(event)
            return None if found is None else self.view.place_of(found[1], other=found[0])
        return None

    def toggle_mark(self) -> None:
        self.marks.toggle(self._events(self.place))

    def next_mark(self, step: int) -> int | None:
        """Return the place of the next (or previous) mark; None if there is none."""
        places = {
            self.view.place_of(i, other=o) for o, i in self.marks.events if self.view.has(other=o)
        }
        beyond = [place for place in places if (place - self.place) * step > 0]
        return min(beyond, key=lambda place: abs(place - self.place), default=None)

    def run_named(self, name: str) -> Run:
        """Return run ``a`` or ``b``; without a name, the first that is shown."""
        return self.runs.get(name) or next(iter(self.shown.values()))

    def place_at_time(self, time: TimeInRun) -> int:
        """Return the place of the first event at a time or later; of the last one if none is."""
        return self._place_at(lambda run: time.stamp_ns(run.trace.start_ns, run.end_ns))

    def place_after(self, since_ns: int) -> int:
        """Return the place of the first event so long after the start of its run, or later."""
        return self._place_at(lambda run: run.base_ns + since_ns)

    def _place_at(self, time: Callable[[Run], int]) -> int:
        found = []
        for name, run in self.shown.items():
            if run.count:
                stamp_ns = time(run)
                place = self.view.place_of(run.index_at(stamp_ns), other=name == RUN_B)
                found.append((run.end_ns < stamp_ns, place))
        over, place = min(found)
        return max(place for _, place in found) if over else place

    # Words.

    def plots(self) -> RunPlots:
        from rsltrace_viewer.model.plots.runs import RunPlots

        found = self.same("topic")
        return RunPlots(
            list(self.shown.values()),
            " ↔ ".join(run.name for run in self.shown.values()),
            topic=found[1] if found is not None else "",
            stamp_ns=None if self.empty else self.stamp(),
            diff=self.comparison.diff
            if self.comparison is not None and self.side == BOTH
            else None,
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
        return self.a.name if self.b is None else f"{self.a.name} ↔ {self.b.name}"

    def facts(self) -> str:
        runs = list(self.shown.values())
        run = runs[0]
        trace = run.trace
        parts = [f"{run.count:,} event{'' if run.count == 1 else 's'}"]
        if len(runs) > 1 and runs[1].count != run.count:
            parts[0] = f"{run.count:,} and {runs[1].count:,} events"
        # What is wrong comes early: little fits into a narrow terminal.
        unfinished = [one.name for one in runs if not one.trace.complete]
        if unfinished:
            parts.append("not finished" if len(runs) == 1 else f"{unfinished[0]} is not finished")
        reason = trace.result.get("exit_code", "0")
        if len(runs) == 1 and reason != "0":
            parts.append(f"exit code {reason}")
        if self.empty:
            return "  ".join(parts)
        how = "of real time" if is_native(trace) else "simulated"
        parts.append(f"{format_duration(run.end_ns - run.start_ns)} {how}")
        if run.base_ns:
            parts.append(f"from {run.start_text()}")
        nodes = sum(1 for e in run.entities.values() if e.kind is EntityKind.NODE)
        parts.append(f"{nodes} node{'' if nodes == 1 else 's'}")
        if len(runs) == 1:
            parts.append("native" if is_native(trace) else f"digest {trace.digest}")
        return "  ".join(parts)


def _numbers_width(runs: Iterable[Run]) -> int:
    return max(3, *(len(str(max(run.count - 1, 0))) for run in runs))
