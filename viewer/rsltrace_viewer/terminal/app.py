"""The viewer: what keys, clicks and answers change, besides moving."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from textual.app import SystemCommand
from textual.binding import Binding
from textual.content import Content
from textual.screen import Screen
from textual.widget import Widget

from rsltrace.errors import TraceError
from rsltrace.job.values.times import parse_time_in_run
from rsltrace.trace.model.texts import printable, shortened
from rsltrace_viewer.model.folder import Event
from rsltrace_viewer.model.query.tokens import QueryError
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.source import place_of_output, source_of
from rsltrace_viewer.session import BOTH, RUN_A, RUN_B, Session
from rsltrace_viewer.terminal.choose import edit, parse_index, question_of
from rsltrace_viewer.terminal.follow import Follow, RerunFollower, walk
from rsltrace_viewer.terminal.keys import KEYS, keys_of
from rsltrace_viewer.terminal.screens.help import HelpScreen
from rsltrace_viewer.terminal.screens.overview import Choice, OverviewScreen
from rsltrace_viewer.terminal.shell import SHARES, WIDE
from rsltrace_viewer.terminal.stepping import Stepping
from rsltrace_viewer.terminal.widgets.inspector import Inspector
from rsltrace_viewer.terminal.widgets.lanes import LanesView
from rsltrace_viewer.terminal.widgets.prompt import Prompt
from rsltrace_viewer.terminal.widgets.timeline import Timeline

if TYPE_CHECKING:
    from rsltrace_viewer.model.callback_question import CallbackQuestion

_ONLY = ("only-timeline", "only-inspector", "only-lanes", "only-source")


class ViewerApp(Stepping):
    BINDINGS: ClassVar = [
        Binding(key.keys, key.action, key.help, show=False, priority=key.first) for key in KEYS
    ]

    def __init__(
        self,
        session: Session,
        *,
        start: int | None = None,
        light: bool = False,
        follow: bool = False,
        filter_text: str = "",
        rerun: RerunFollower | None = None,
        overview: bool = False,
    ) -> None:
        """Show ``session``, at place ``start`` (None: where it is); its ``overview`` first, if
        that is wanted."""
        super().__init__(session, start=start, light=light)
        self._overview_first = overview
        self._rerun = rerun
        self._first_filter = filter_text
        self._follow: Follow | None = None
        self._follow_at_once = follow

    def on_mount(self) -> None:
        if self._overview_first and not self.session.empty:
            self._push_overview(first=True)

    def first_shown(self) -> None:
        """Filter and follow, if that was asked for at the start."""
        if self._first_filter:
            self._filter(self._first_filter)
        if self._follow_at_once:
            self.action_follow()
        if self._rerun is not None:
            self._rerun.start(partial(self.call_from_thread, self._rerun_said))
            self.rested()

    def rested(self) -> None:
        here = self.session.current()
        if self._rerun is not None and here is not None:
            both = self.session.comparison
            of_b = both is not None and here[0] is both.run_b
            row = both.place_of(here[1], other=of_b) if both is not None else None
            self._rerun.select(here[1], here[0].stamp(here[1]), row)

    def _rerun_said(self, text: str, is_over: bool) -> None:
        if is_over:
            self.notify(text, severity="error")
        self._say(text)

    # Asking.

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Some keys come before the pane that has the focus, but not while one types."""
        if action == "ask":
            alone = len(self.screen_stack) == 1 or isinstance(self.screen, OverviewScreen)
            return not self.prompt.asking and alone
        if action == "pane":
            return not self.prompt.asking
        return True

    def action_ask(self, kind: str) -> None:
        self._leave_overview()
        self.prompt.ask(question_of(kind, self.session))

    def on_prompt_answered(self, event: Prompt.Answered) -> None:
        self.timeline.focus()
        if event.text is None:
            return
        if event.kind == "search":
            self.session.set_search(event.text)
            if self.session.search is not None:
                self.action_next_match(1)
        elif event.kind == "filter":
            self._filter(event.text)
        elif not self.session.empty and event.text.strip():
            if event.kind == "time":
                time = parse_time_in_run(event.text)
                self.go(self.session.place_at_time(time), centre=True)
            else:
                name, index = parse_index(event.text)
                run = self.session.run_named(name)
                self._go_to_event(index, other=run is self.session.b)

    def _filter(self, text: str) -> None:
        rows = self.session.set_filter(text)
        self.workers.cancel_group(self, "filter")
        if rows is None:
            self.timeline.empty = self.session.nothing
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
            part = "" if done else f" ({progress or 0:.0%} read, Esc ends it)"
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
        elif self.has_worker("seek"):
            self.workers.cancel_group(self, "seek")
            self._say("stopped")
        elif self.has_worker("filter"):
            self._filter("")
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
        self.timeline.focus()
        self.go(self.session.rows.at(event.row))

    def on_lanes_view_picked(self, event: LanesView.Picked) -> None:
        session = self.session
        if session.empty:
            return
        if event.order:
            self.go(event.position, centre=True)
        else:
            self.go(session.place_after(event.position), centre=True)

    def on_lanes_view_zoomed(self, event: LanesView.Zoomed) -> None:
        self.action_zoom(event.step)

    def panes(self) -> list[Widget]:
        return [self.timeline, self.inspector, self.source, self.lanes]

    def action_pane(self, step: int) -> None:
        if self._leave_overview():
            return
        if len(self.screen_stack) > 1:
            self.screen.focus_next()
            return
        shown = [pane for pane in self.panes() if pane.display and pane.size.height]
        place = shown.index(self.focused) if self.focused in shown else -step
        shown[(place + step) % len(shown)].focus()

    def action_zoom(self, step: int) -> None:
        self.session.zoom(step, self.lanes.columns)
        self._show_lanes()

    def action_maximise(self) -> None:
        screen = self.screen_stack[0]
        if any(screen.has_class(name) for name in _ONLY):
            screen.remove_class(*_ONLY)
        elif self.focused is not None and f"only-{self.focused.id}" in _ONLY:
            screen.add_class(f"only-{self.focused.id}")

    def action_resize(self, step: int) -> None:
        """Make the pane one is in larger (1) or smaller (-1)."""
        if self.focused is self.lanes:
            self._more_lanes += step
        else:
            share = self._share or (8 if self.size.width >= WIDE else 6)
            share += step if self.focused is self.timeline else -step
            self._share = max(2, min(share, SHARES - 2))
        self._fit(self.size.width, self.size.height)
        self.call_after_refresh(self._redraw)

    def action_overview(self) -> None:
        self._push_overview(first=False)
        if not self.session.overviews:
            walk(self, "overview", self.session.survey(), self._looked)

    def _leave_overview(self) -> bool:
        if not isinstance(self.screen, OverviewScreen):
            return False
        self.screen.dismiss(None)
        return True

    def _push_overview(self, *, first: bool) -> None:
        def chosen(choice: Choice | None) -> None:
            if choice is None:
                return
            what, text = choice
            if what == "event":
                name, index = parse_index(text)
                self._go_to_event(index, other=name == RUN_B)
            elif what == "key":
                self.call_next(self.run_action, text)
            elif what == "reason":
                from rsltrace_viewer.model.callback_question import CallbackQuestion

                node, _, name = text.partition(" ")
                self._answer(CallbackQuestion(self.session.a, False, node, name))
            else:
                try:
                    self._filter(text)
                except QueryError as error:
                    self.notify(f"{text}: {error}", severity="error")

        self.push_screen(OverviewScreen(self.session, first=first), chosen)

    def action_log(self) -> None:
        from rsltrace_viewer.terminal.screens.logs import LogScreen

        def chosen(event: Event | None) -> None:
            if event is not None:
                self._go_to_event(event[1], other=event[0])

        self.push_screen(LogScreen(self.session), chosen)

    def action_source(self) -> None:
        self.screen_stack[0].toggle_class("with-source")
        self.call_after_refresh(self._redraw)
        self._show_source()

    def action_edit(self) -> None:
        """Open the callback in an editor, of an output in the inspector the line that sent it; the
        viewer waits for it."""
        here = self.session.current()
        if here is None:
            return
        try:
            source = source_of(*here)
            place = self._place_of_output(*here)
        except TraceError as error:
            self.notify(str(error), severity="error")
            return
        if place is not None:
            self._say(edit(self, *place) or (source.note if source is not None else ""))
        elif source is None:
            self._say("the trace does not say where its callback is")
        elif not source.lines:
            self.notify(f"{source.file}:{source.line} {source.note}", severity="warning")
        else:
            said = edit(self, Path(source.file), source.line)
            self._say(said or source.note)

    def _place_of_output(self, run: Run, index: int) -> tuple[Path, int] | None:
        inspector = self._focused_inspector()
        line = inspector.current if inspector is not None else None
        words = line.path.split(".") if line is not None else []
        if words[:1] != ["out"] or len(words) < 2 or not words[1].isdecimal():
            return None
        return place_of_output(run, index, int(words[1]))

    def action_yank(self) -> None:
        """Copy the event, or the line of the inspector one is at, to the clipboard."""
        inspector = self._focused_inspector()
        if inspector is not None and inspector.current is not None:
            line = inspector.current
            text = f"{line.label} {line.value}".strip()
        elif self.session.rows.count:
            event = self.session.row(self.session.row_of_place()).event
            numbers = " / ".join(filter(None, event.numbers)) or str(event.index)
            parts = (numbers, event.time, event.node, event.kind, event.entity)
            text = " ".join((*parts, event.outputs)).strip()
        else:
            return
        text = printable(text)
        self.copy_to_clipboard(text)
        self._say(f"copied: {shortened(text, 40)}")

    def action_help(self) -> None:
        self.push_screen(HelpScreen(two=self.session.b is not None, live=self.live))

    def action_plot(self) -> None:
        from rsltrace_viewer.terminal.screens.plot import PlotScreen

        self.push_screen(PlotScreen(self.session.plots()))

    def action_reason(self) -> None:
        """Ask why the selected callback did not come, or came late."""
        question = self.session.question()
        if question is None:
            self._say("r asks about callbacks: of subscriptions, timers, services, clients")
        else:
            self._answer(question)

    def _answer(self, question: CallbackQuestion) -> None:
        from rsltrace_viewer.terminal.screens.text import TextScreen

        def gone(event: int | None) -> None:
            if event is not None:
                self._go_to_event(event, other=question.other)

        def arrive(found: tuple[str, list[str], int | None] | None, done: bool) -> None:
            if found is not None:
                self._say("")
                command, lines, event = found
                text = Content.styled(lines[0], "bold") + Content("\n" + "\n".join(lines[1:]))
                self.push_screen(TextScreen(command, text, event), gone)

        self._say("looking for the reason … Esc stops")
        walk(self, "seek", question.answers(), arrive, at_once_s=0)

    def action_verdict(self) -> None:
        comparison = self.session.comparison
        if comparison is None:
            self._say("this is one trace; rsltrace view A B compares two")
        elif comparison.diff is None:
            self._say(comparison.verdict() if comparison.identical else "still looking …")
        else:
            from rsltrace_viewer.terminal.screens.report import ReportScreen

            self.push_screen(ReportScreen(comparison.diff))

    def action_other(self) -> None:
        session = self.session
        side = session.next_side()
        if session.filter_text:
            self._filter(session.filter_text)
        self.side_changed()
        self.go(session.place, remember=False, centre=True)
        self._say({BOTH: "both runs", RUN_A: "run a only", RUN_B: "run b only"}[side])

    def action_follow(self) -> None:
        """Follow a file that is still being recorded, or stop that."""
        if self._follow is not None:
            self._follow.stop()
            self._follow, self.following = None, False
            self._show_header()
            self._say("no longer following")
        elif self.session.b is not None:
            self._say("only one trace can be followed")
        elif self.session.a.trace.complete:
            self._say("this trace is finished: there is nothing to follow")
        else:
            self.following = True
            self._show_header()
            self._follow = Follow(self, Path(self.session.a.trace.name), self._grown)
            self._say("following; Esc stops")

    def _grown(self, run: Run) -> None:
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
            self._follow, self.following = None, False
            self._say("the recording has ended")
        self.look_through()

    def get_system_commands(self, screen: Screen[Any]) -> Iterator[SystemCommand]:
        """Offer all keys by their help in the command palette, and nothing of Textual's own."""
        for key in keys_of(two=self.session.b is not None, live=self.live):
            yield SystemCommand(f"{key.help}", f"key {key.shown}", self._runner(key.action))

    def _runner(self, action: str) -> Any:
        async def run() -> None:
            self._leave_overview()
            await self.run_action(action)

        return run


def open_session(a: Path, b: Path | None = None) -> Session:
    """Open one or two traces. Raises TraceError, TraceFormatError."""
    opened = [Run.open(a)]
    try:
        if b is not None:
            opened.append(Run.open(b))
        return Session(*opened)
    except TraceError:
        for run in opened:
            with suppress(OSError):
                run.close()
        raise
