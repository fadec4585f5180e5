"""The viewer: puts the widgets together, turns keys into changes of the session, draws it.

Everything there is to know about a trace is in ``Session`` and below; here is only what a screen
needs. Whatever could take long goes through ``background.walk``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

from textual import events
from textual.app import App, ComposeResult, SystemCommand
from textual.binding import Binding
from textual.containers import Container
from textual.geometry import Size
from textual.screen import Screen
from textual.worker import get_current_worker

from rsltrace.errors import RsltraceError, TraceError
from rsltrace_viewer.background import walk
from rsltrace_viewer.follow import Follow
from rsltrace_viewer.keys import KEYS
from rsltrace_viewer.model.effects import effects_of
from rsltrace_viewer.model.inspector import Effects, summary_line
from rsltrace_viewer.model.match import Condition
from rsltrace_viewer.model.query import completions, parse
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.times import parse_time
from rsltrace_viewer.screens.help import HelpScreen
from rsltrace_viewer.screens.pick import PickScreen
from rsltrace_viewer.session import SEEK, Session
from rsltrace_viewer.widgets.bars import FooterBar, HeaderBar
from rsltrace_viewer.widgets.inspector import Inspector
from rsltrace_viewer.widgets.lanes import LanesView
from rsltrace_viewer.widgets.prompt import Prompt, Question
from rsltrace_viewer.widgets.timeline import Row, Timeline

_WIDE = 110
_REPORT_S = 0.25
_EFFECTS_AT_ONCE_S = 0.004
_INSPECT_S = 0.02
"""Events are inspected when one has stopped at them for this long: holding a key stays smooth."""


class ViewerApp(App[None]):
    """One session on the screen."""

    TITLE = "rsltrace view"
    ENABLE_COMMAND_PALETTE = True
    BINDINGS: ClassVar = [
        Binding(key.keys, key.action, key.help, show=False, priority=key.first) for key in KEYS
    ]
    CSS = """
    Screen { layout: vertical; overflow: hidden; }
    #body { height: 1fr; layout: vertical; }
    #timeline { height: 5fr; width: 1fr; }
    #inspector { height: 4fr; width: 1fr; border-top: solid $panel; }
    .wide #body { layout: horizontal; }
    .wide #timeline { height: 1fr; width: 5fr; }
    .wide #inspector { height: 1fr; width: 3fr; border-top: none; border-left: solid $panel; }
    .low #lanes { display: none; }
    .lowest #inspector { display: none; }
    #inspector:focus { border-top: solid $accent; }
    .wide #inspector:focus { border-top: none; border-left: solid $accent; }
    .only-timeline #lanes, .only-timeline #inspector { display: none; }
    .only-inspector #lanes, .only-inspector #timeline { display: none; }
    .only-lanes #body { display: none; }
    .only-lanes #lanes { height: 1fr; }
    """

    def __init__(
        self,
        session: Session,
        *,
        start: int | None = None,
        light: bool = False,
        follow: bool = False,
        filter_text: str = "",
    ) -> None:
        """Show ``session``, at place ``start`` (None: where it is)."""
        super().__init__()
        self.session = session
        self.busy = True
        """Whether something is about to be drawn that is not yet: for pictures and tests."""
        self._start = start
        self._first_filter = filter_text
        self._status = ""
        self._follow: Follow | None = None
        self._follow_at_once = follow
        self.theme = "textual-light" if light else "textual-dark"

    # Setting up.

    def compose(self) -> ComposeResult:
        """Make the parts."""
        yield HeaderBar(id="header")
        yield LanesView(id="lanes")
        with Container(id="body"):
            yield Timeline(id="timeline")
            yield Inspector(id="inspector")
        yield Prompt(id="prompt")
        yield FooterBar(id="footer")

    def on_mount(self) -> None:
        """Show the first screen; everything that can wait comes after it."""
        session = self.session
        self._fit(self.size.width, self.size.height)
        self.timeline.focus()
        if self._start is not None:
            session.go(self._start, remember=False)
        self.timeline.empty = _NO_EVENTS if session.empty else ""
        self._show_header()
        self.call_after_refresh(self._after_first)

    def _after_first(self) -> None:
        self._show_rows(centre=True)
        self._show_lanes()
        self.call_after_refresh(self._after_second)

    def _after_second(self) -> None:
        self._show_inspector()
        self.busy = False
        if self._first_filter:
            self._filter(self._first_filter)
        if self._follow_at_once:
            self.action_follow()
        walk(self, "lanes", self._summaries(), lambda _, done: self._show_lanes(), at_once_s=0)
        comparison = self.session.comparison
        if comparison is not None and not comparison.identical:
            self.run_worker(self._explain, group="diff", thread=True, exit_on_error=False)

    def _explain(self) -> None:
        """Let the diff find the reason, then match the rest of the runs. Runs in a thread."""
        comparison = self.session.comparison
        worker = get_current_worker()
        assert comparison is not None  # started for two runs only
        try:
            comparison.finish_diff()
        except RsltraceError as error:
            self.call_from_thread(self.notify, str(error), severity="error")
        if not worker.is_cancelled:
            self.call_from_thread(self._explained)
        shown = perf_counter()
        while not comparison.done and not worker.is_cancelled:
            try:
                stretch = comparison.fetch()
            except RsltraceError as error:
                self.call_from_thread(self.notify, str(error), severity="error")
                return
            # On the app's thread: the view must not change while a screen is drawn from it.
            self.call_from_thread(self.session.take_stretch, stretch)
            if comparison.done or perf_counter() - shown > _REPORT_S:
                self.call_from_thread(self._show_rows)
                shown = perf_counter()

    def _explained(self) -> None:
        self._show_header()
        self._show_inspector(top=False)

    def _summaries(self) -> Iterator[int]:
        for number in self.session.lane_maker.order():
            self.session.lane_maker.summarise(number)
            yield number

    @property
    def timeline(self) -> Timeline:
        """The list of events."""
        return self.screen_stack[0].query_one(Timeline)

    @property
    def inspector(self) -> Inspector:
        """The selected event."""
        return self.screen_stack[0].query_one(Inspector)

    @property
    def lanes(self) -> LanesView:
        """The overview."""
        return self.screen_stack[0].query_one(LanesView)

    @property
    def prompt(self) -> Prompt:
        """The question line."""
        return self.screen_stack[0].query_one(Prompt)

    def _fit(self, width: int, height: int) -> None:
        """Use the screen there is."""
        screen = self.screen_stack[0]
        screen.set_class(width >= _WIDE, "wide")
        screen.set_class(height < 16, "low")
        screen.set_class(height < 11 or (width < _WIDE and height < 14), "lowest")
        self.lanes.fit_labels(self.session.lane_maker.labels, width)
        most = max(4, height // 5)
        self.lanes.styles.height = min(len(self.session.lane_maker.labels), most) + 1

    # Drawing.

    def _show_header(self, size: Size | None = None) -> None:
        session, size = self.session, size or self.size
        verdict, bad = "", False
        if session.comparison is not None:
            verdict, bad = session.comparison.verdict(), not session.comparison.identical
        self.screen_stack[0].query_one(HeaderBar).show(
            session.title(),
            session.facts(),
            verdict,
            bad=bad,
            lines=2 if size.height >= 20 else 1 if size.height >= 10 else 0,
            width=size.width,
        )

    def _show_rows(self, *, centre: bool = False) -> None:
        timeline, session = self.timeline, self.session
        timeline.show(self._row, session.rows.count, session.columns(timeline.row_width))
        if session.rows.count:
            timeline.go(session.row_of_place(), centre=centre)
        self._show_footer()

    def _row(self, row: int) -> Row:
        event, sign, marked, related = self.session.row(row)
        return Row(event, sign, marked, related)

    def _show_lanes(self) -> None:
        lanes, session = self.lanes, self.session
        if not lanes.size.width:
            return
        made, position = session.lanes(lanes.columns)
        divergence = None
        if session.comparison is not None:
            divergence = session.comparison.divergence_in(made.window)
        lanes.show(made, position, own=session.own_lane(), divergence=divergence)

    def _show_inspector(self, *, top: bool = True) -> None:
        session = self.session
        self.inspector.show(session.lines(), top=top)
        here = session.current()
        if here is not None and session.effects is None:
            walk(
                self,
                "effects",
                effects_of(*here),
                self._effects_arrived,
                at_once_s=_EFFECTS_AT_ONCE_S,
            )

    def _effects_arrived(self, effects: Effects | None, done: bool) -> None:
        here = self.session.current()
        if effects is None or here is None or effects.event != here[1]:
            return
        self.session.effects = effects
        self.inspector.show(self.session.lines(), top=False)
        if effects.found:
            self.timeline.redraw()

    def _show_footer(self) -> None:
        session = self.session
        status = self._status
        if not status and session.filter_text:
            status = f"filter: {session.rows.count:,} of {session.view.count:,}"
        if not status and not session.empty:
            following = "following  " if self._follow is not None else ""
            status = f"{following}{session.place + 1:,}/{session.view.count:,}"
        searching = "match" if session.search is not None else "divergence" if session.b else ""
        self.screen_stack[0].query_one(FooterBar).show(
            two=session.b is not None, searching=searching, status=status
        )

    def _say(self, status: str) -> None:
        self._status = status
        self._show_footer()

    def go(self, place: int, *, remember: bool = True, centre: bool = False) -> None:
        """Select a place and show everything about it."""
        session = self.session
        if session.empty:
            return
        related = session.effects is not None or bool(session.place != place)
        session.go(place, remember=remember)
        self._status = ""
        self.timeline.go(session.row_of_place(), centre=centre)
        if related:
            self.timeline.redraw()
        self._show_lanes()
        self._show_footer()
        self.busy = True
        self.set_timer(_INSPECT_S, self._inspect_if_still(session.place))

    def _inspect_if_still(self, place: int) -> Any:
        def inspect() -> None:
            if self.session.place == place and self.screen_stack:
                self._show_inspector()
                self.busy = False

        return inspect

    def on_resize(self, event: events.Resize) -> None:
        """Use the new size, which the app and its parts will have a moment later."""
        self._fit(event.size.width, event.size.height)
        self._show_header(event.size)
        self.call_after_refresh(self._redraw)

    def on_timeline_resized(self) -> None:
        """Lay the columns out again."""
        self._show_rows()

    def on_lanes_view_resized(self) -> None:
        """Count again."""
        self._show_lanes()

    def _redraw(self) -> None:
        self._show_rows()
        self._show_lanes()

    # Stepping.

    def _focused_inspector(self) -> Inspector | None:
        inspector = self.inspector
        return inspector if self.focused is inspector else None

    def action_step(self, step: int) -> None:
        """Go to the next row (or line of the inspector, if one is in it)."""
        inspector = self._focused_inspector()
        if inspector is not None:
            inspector.move(step)
            return
        self._step_rows(step)

    def _step_rows(self, rows: int, pages: int = 0) -> None:
        session = self.session
        if not session.rows.count:
            return
        row = max(min(session.row_of_place() + rows, session.rows.count - 1), 0)
        place = session.rows.at(row)
        if pages:
            self.timeline.page_to(row, pages)
        self.go(place, remember=False)

    def action_page(self, pages: int) -> None:
        """Go on by a screen."""
        inspector = self._focused_inspector()
        if inspector is not None:
            inspector.move(pages * inspector.page)
            return
        self._step_rows(pages * self.timeline.page, pages)

    def action_edge(self, edge: int) -> None:
        """Go to the first (-1) or last (1) row."""
        inspector = self._focused_inspector()
        if inspector is not None:
            inspector.move(edge * 10**9)
        elif self.session.rows.count:
            row = 0 if edge < 0 else self.session.rows.count - 1
            self.go(self.session.rows.at(row))

    def action_same(self, what: str, step: int) -> None:
        """Go to the next event of the same node, entity or topic."""
        found = self.session.same(what)
        if found is None:
            self._say(f"this event has no {what}")
            return
        condition, name = found
        self._seek(condition, step, f"event of {name}" if what != "topic" else f"event on {name}")

    def action_seek(self, what: str, step: int) -> None:
        """Go to the next exception, log record, warning or finding."""
        condition, name = SEEK[what]
        self._seek(condition, step, name)

    def action_again(self, step: int) -> None:
        """Go to the next match of the search; without one, to the next divergence."""
        session = self.session
        if session.search is not None:
            self._seek(session.search, step, f"match of {session.search_text}", wrap=True)
        elif session.comparison is not None:
            place = session.comparison.next_divergence(session.place, step)
            if place is None:
                self._say(f"no {'later' if step > 0 else 'earlier'} divergence")
            else:
                self.go(place, centre=True)
        else:
            self._say("nothing is searched: / searches")

    def _seek(self, condition: Condition, step: int, name: str, *, wrap: bool = False) -> None:
        """Go to the nearest place where a condition holds, looking for it in the background."""

        def steps() -> Iterator[int | None]:
            looked = enumerate(self.session.seek(condition, step, wrap=wrap), start=1)
            for count, place in looked:
                if place is not None:
                    yield place
                    return
                yield -count

        def arrive(found: int | None, done: bool) -> None:
            if found is not None and found >= 0:
                self.go(found, centre=True)
            elif done:
                self._say(f"no {'later' if step > 0 else 'earlier'} {name}")
            elif found is not None:
                share = -found / max(len(self.session.a.segments), 1)
                self._say(f"looking for {name} … {share:.0%}, Esc stops")

        walk(self, "seek", steps(), arrive)

    # Cause and effect, history, marks.

    def action_cause(self) -> None:
        """Go to the cause."""
        here = self.session.current()
        if here is None:
            return
        run, index = here
        cause = int(run.row(index)["cause_event"])
        if not 0 <= cause < run.count:
            self._say("no other event caused this one")
            return
        self.go(self.session.view.place_of(cause, other=run is self.session.b))

    def action_effect(self) -> None:
        """Go to the effect, or let choose between several."""
        here = self.session.current()
        if here is None:
            return
        run, index = here
        session = self.session

        def arrive(effects: Effects | None, done: bool) -> None:
            if not done or effects is None:
                return
            session.effects = effects
            if not effects.found:
                self._say(f"it caused nothing up to event {effects.searched}")
            elif len(effects.found) == 1:
                self._go_to_event(effects.found[0], other=run is session.b)
            else:
                self._choose_effect(run, effects)

        walk(self, "effects", effects_of(run, index), arrive)

    def _choose_effect(self, run: Run, effects: Effects) -> None:
        def chosen(number: int | None) -> None:
            if number is not None:
                self._go_to_event(effects.found[number], other=run is self.session.b)

        choices = [summary_line(run, index) for index in effects.found[:200]]
        self.push_screen(PickScreen(f"event {effects.event} caused", choices), chosen)

    def _go_to_event(self, index: int, *, other: bool) -> None:
        self.go(self.session.view.place_of(index, other=other))

    def action_go_back(self) -> None:
        """Go back to where one was."""
        self._travel(self.session.history.back(self.session.place), "the start of your way")

    def action_go_forward(self) -> None:
        """Go forward again."""
        self._travel(self.session.history.forward(self.session.place), "where you came from last")

    def _travel(self, place: int | None, what: str) -> None:
        if place is None:
            self._say(f"this is {what}")
        else:
            self.go(place, remember=False, centre=True)

    def action_mark(self) -> None:
        """Mark the place, or remove its mark."""
        if not self.session.empty:
            self.session.marks.toggle(self.session.place)
            self.timeline.redraw()

    def action_next_mark(self, step: int) -> None:
        """Go to the next mark."""
        place = self.session.marks.next(self.session.place, step)
        if place is None:
            self._say("no mark there; m sets one")
        else:
            self.go(place, centre=True)

    # Asking.

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Some keys come before the part that has the focus, but not while one types."""
        if action == "ask":
            return not self.prompt.asking and len(self.screen_stack) == 1
        if action == "pane":
            return not self.prompt.asking
        return True

    def action_ask(self, kind: str) -> None:
        """Ask for a search, a filter, a time or an index."""
        session = self.session

        def check_query(text: str) -> object:
            return parse(text, session.a)

        def complete(text: str) -> list[str]:
            return completions(text, session.a)

        questions = {
            "search": Question(
                "search",
                "search",
                "a word, or node: topic: kind: text: level: … as in a filter; Enter finds the next",
                "",
                check_query,
                complete,
            ),
            "filter": Question(
                "filter",
                "filter",
                "node: topic: kind: level: time: text: …  Tab completes, empty shows all",
                session.filter_text,
                check_query,
                complete,
            ),
            "time": Question("time", "go to time", "seconds, or 20ms, 3us, 500ns", "", parse_time),
            "index": Question(
                "index", "go to event", f"0 to {max(session.a.count - 1, 0)}", "", _parse_index
            ),
        }
        self.prompt.ask(questions[kind])

    def on_prompt_answered(self, event: Prompt.Answered) -> None:
        """Do what was asked for."""
        self.timeline.focus()
        if event.text is None:
            return
        if event.kind == "search":
            self.session.set_search(event.text)
            if self.session.search is not None:
                self.action_again(1)
        elif event.kind == "filter":
            self._filter(event.text)
        elif not self.session.empty and event.text.strip():
            if event.kind == "time":
                self.go(self.session.place_at_time(parse_time(event.text)), centre=True)
            else:
                index = min(_parse_index(event.text), self.session.a.count - 1)
                self.go(self.session.view.place_of(index), centre=True)

    def _filter(self, text: str) -> None:
        rows = self.session.set_filter(text)
        self.workers.cancel_group(self, "filter")
        if rows is None:
            self.timeline.empty = _NO_EVENTS
            self._say("")
            self._show_rows(centre=True)
            return

        def steps() -> Iterator[float]:
            while not rows.done:
                rows.advance()
                yield rows.progress

        def arrive(progress: float | None, done: bool) -> None:
            if self.session.rows is not rows:
                return
            self.timeline.empty = "no event passes the filter" if done else "looking …"
            part = "" if done else f" ({progress or 0:.0%} read)"
            self._status = f"filter: {rows.count:,} events{part}"
            if rows.count:
                self.session.place = rows.at(self.session.row_of_place())
            self._show_rows(centre=True)
            if done:
                self._show_lanes()
                self._show_inspector()

        walk(self, "filter", steps(), arrive)

    def action_escape(self) -> None:
        """End the nearest thing that can be ended."""
        session = self.session
        screen = self.screen_stack[0]
        if self.prompt.asking:
            self.prompt.put_aside()
        elif any(w.group == "seek" and w.is_running for w in self.workers):
            self.workers.cancel_group(self, "seek")
            self._say("stopped")
        elif any(screen.has_class(name) for name in _ONLY):
            screen.remove_class(*_ONLY)
        elif self.focused is not self.timeline:
            self.timeline.focus()
        elif session.search is not None:
            session.set_search("")
            self._say("")
        elif session.filter_text:
            self._filter("")
        elif self._follow is not None:
            self.action_follow()

    # Looking.

    def action_enter(self) -> None:
        """Open, close or follow the line of the inspector; go there first."""
        inspector = self._focused_inspector()
        if inspector is None:
            self.inspector.focus()
        elif inspector.current is not None:
            self._choose_line(inspector.current.path, inspector)

    def on_inspector_chosen(self, event: Inspector.Chosen) -> None:
        """A line was clicked."""
        self._choose_line(event.line.path, self.inspector)

    def _choose_line(self, path: str, inspector: Inspector) -> None:
        line = next((line for line in inspector.lines if line.path == path), None)
        if line is None:
            return
        if line.link is not None:
            self._go_to_event(line.link, other=line.other_run)
        elif line.open is not None:
            self.session.openness.toggle(line.path)
            self._show_inspector(top=False)

    def on_timeline_picked(self, event: Timeline.Picked) -> None:
        """A row was clicked."""
        self.timeline.focus()
        self.go(self.session.rows.at(event.row))

    def on_lanes_view_picked(self, event: LanesView.Picked) -> None:
        """A column of the lanes was clicked."""
        session = self.session
        if session.empty:
            return
        if event.order:
            self.go(session.view.place_of(min(event.position, session.a.count - 1)), centre=True)
        else:
            self.go(session.place_at_time(event.position), centre=True)

    def action_pane(self, step: int) -> None:
        """Go to the next part of the screen."""
        if len(self.screen_stack) > 1:
            self.screen.focus_next()
            return
        panes = [self.timeline, self.inspector, self.lanes]
        shown = [pane for pane in panes if pane.display and pane.size.height]
        place = shown.index(self.focused) if self.focused in shown else -step
        shown[(place + step) % len(shown)].focus()

    def action_zoom(self, step: int) -> None:
        """Zoom the lanes."""
        self.session.zoom(step, self.lanes.columns)
        self._show_lanes()

    def action_maximise(self) -> None:
        """Give the whole screen to the current part."""
        screen = self.screen_stack[0]
        if any(screen.has_class(name) for name in _ONLY):
            screen.remove_class(*_ONLY)
        elif self.focused is not None and f"only-{self.focused.id}" in _ONLY:
            screen.add_class(f"only-{self.focused.id}")

    def action_theme(self) -> None:
        """Change between dark and light."""
        self.theme = "textual-dark" if self.theme == "textual-light" else "textual-light"

    def action_help(self) -> None:
        """Show all keys."""
        self.push_screen(HelpScreen(two=self.session.b is not None))

    def action_plot(self) -> None:
        """Open the plots."""
        from rsltrace_viewer.screens.plot import PlotScreen

        self.push_screen(PlotScreen(self.session))

    def action_verdict(self) -> None:
        """Show the whole report on two traces."""
        comparison = self.session.comparison
        if comparison is None:
            self._say("this is one trace; rsltrace view A B compares two")
        elif comparison.diff is None:
            self._say("the runs are identical" if comparison.identical else "still looking …")
        else:
            from rsltrace_viewer.screens.report import ReportScreen

            self.push_screen(ReportScreen(comparison.diff))

    def action_other(self) -> None:
        """Inspect the differences, run a, run b in turn."""
        side = self.session.next_side()
        self._show_rows()
        self._show_inspector()
        self._say({"diff": "the differences", "a": "run a only", "b": "run b only"}[side])

    def action_follow(self) -> None:
        """Follow a file that is still being recorded, or stop that."""
        if self._follow is not None:
            self._follow.stop()
            self._follow = None
            self._say("no longer following")
        elif self.session.b is not None:
            self._say("only one trace can be followed")
        elif self.session.a.trace.complete:
            self._say("this trace is finished: there is nothing to follow")
        else:
            self._follow = Follow(self, Path(self.session.a.trace.name), self._grown)
            self._say("following; Esc stops")

    def _grown(self, run: Run) -> None:
        """Show a trace that got longer."""
        session = self.session
        at_end = session.empty or session.place >= session.view.count - 1
        session.replace_run(run)
        self._fit(self.size.width, self.size.height)
        self._show_header()
        if session.filter_text:
            self._filter(session.filter_text)
        if at_end and not session.empty:
            self.go(session.view.count - 1, remember=False)
        self._show_rows()
        self._show_lanes()
        if run.trace.complete:
            self._follow = None
            self._say("the recording has ended")
        walk(self, "lanes", self._summaries(), lambda _, done: self._show_lanes(), at_once_s=0)

    def get_system_commands(self, screen: Screen[Any]) -> Iterator[SystemCommand]:
        """Offer all keys by their help in the command palette."""
        yield from super().get_system_commands(screen)
        for key in KEYS:
            if self.session.b is not None or not key.two:
                yield SystemCommand(f"{key.help}", f"key {key.shown}", self._runner(key.action))

    def _runner(self, action: str) -> Any:
        async def run() -> None:
            await self.run_action(action)

        return run

    async def action_quit(self) -> None:
        """Leave."""
        self.workers.cancel_all()
        self.exit()


_NO_EVENTS = "no events in this trace"
_ONLY = ("only-timeline", "only-inspector", "only-lanes")


def _parse_index(text: str) -> int:
    cleaned = text.strip().replace(",", "").replace("_", "").lstrip("#")
    if not cleaned.isdecimal():
        raise ValueError(f"{text!r} is no whole number")
    return int(cleaned)


def open_session(a: Path, b: Path | None = None) -> Session:
    """Open one or two traces. Raises TraceError, TraceFormatError."""
    first = Run.open(a)
    try:
        return Session(first, Run.open(b) if b is not None else None)
    except TraceError:
        with suppress(OSError):
            first.close()
        raise
