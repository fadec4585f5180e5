"""The screen: puts the widgets together and draws what the session says.

Everything there is to know about a trace is in ``Session`` and below; here is only what a screen
needs. Whatever could take long goes through ``background.walk``. What keys do is in ``stepping``
and ``app``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from itertools import chain
from time import perf_counter

from textual import events
from textual.app import ComposeResult
from textual.containers import Container
from textual.geometry import Size
from textual.worker import get_current_worker

from rsltrace.errors import RsltraceError
from rsltrace_viewer.model.inspector.effects import Effects, effects_of
from rsltrace_viewer.model.source import CallbackCode, source_of
from rsltrace_viewer.session import Session
from rsltrace_viewer.terminal.base import BaseApp
from rsltrace_viewer.terminal.follow import walk
from rsltrace_viewer.terminal.screens.overview import OverviewScreen
from rsltrace_viewer.terminal.widgets.bars import FooterBar, HeaderBar, verdict_lines
from rsltrace_viewer.terminal.widgets.inspector import Inspector
from rsltrace_viewer.terminal.widgets.lanes import LanesView
from rsltrace_viewer.terminal.widgets.prompt import Prompt
from rsltrace_viewer.terminal.widgets.source import SourceView
from rsltrace_viewer.terminal.widgets.timeline import Timeline

WIDE = 110
_VALUES_S = 0.12
"""Messages are decoded, and files read, when one has stopped for this long."""
SHARES = 12
_REPORT_S = 0.25
_EFFECTS_AT_ONCE_S = 0.004
_INSPECT_S = 0.02
"""Events are inspected when one has stopped at them for this long: holding a key stays smooth."""


class Shell(BaseApp):
    """One session on the screen; what one can do with it is added by subclasses."""

    live = False
    """Whether events are executed."""
    CSS = """
    Screen { layout: vertical; overflow: hidden; }
    #body { height: 1fr; layout: vertical; }
    #timeline { height: 5fr; width: 1fr; }
    #detail { height: 4fr; width: 1fr; layout: horizontal; }
    #inspector { height: 1fr; width: 1fr; }
    #source { height: 1fr; width: 1fr; display: none; }
    .with-source #source { display: block; }
    .wide #body { layout: horizontal; }
    .wide #timeline { height: 1fr; width: 2fr; }
    .wide #detail { layout: vertical; width: 1fr; height: 1fr; border-left: solid $panel; }
    .wide #inspector { height: 5fr; }
    .wide #source { height: 4fr; }
    .low #lanes { display: none; }
    .lowest #detail { display: none; }
    .only-timeline #lanes, .only-timeline #detail { display: none; }
    .only-inspector #lanes, .only-inspector #timeline, .only-inspector #source { display: none; }
    .only-source #timeline, .only-source #inspector, .only-source #lanes { display: none; }
    .only-inspector #detail, .only-source #detail { border-left: none; }
    .only-lanes #body { display: none; }
    .only-lanes #lanes { height: 1fr; }
    """

    def __init__(
        self,
        session: Session,
        *,
        start: int | None = None,
        light: bool = False,
    ) -> None:
        """Show ``session``, at place ``start`` (None: where it is)."""
        super().__init__(light=light)
        self.session = session
        self._start = start
        self._share = 0
        """Of SHARES, how many the events have; 0: as the style sheet says."""
        self._more_lanes = 0
        self._status = ""
        self._soon: asyncio.TimerHandle | None = None
        self.following = False

    # Setting up.

    def compose(self) -> ComposeResult:
        yield HeaderBar(id="header")
        yield LanesView(id="lanes")
        with Container(id="body"):
            yield Timeline(id="timeline")
            with Container(id="detail"):
                yield Inspector(id="inspector")
                yield SourceView(id="source")
        yield Prompt(id="prompt")
        yield FooterBar(id="footer")

    def on_mount(self) -> None:
        """Show the first screen; everything that can wait comes after it."""
        session = self.session
        self._fit(self.size.width, self.size.height)
        self.timeline.focus()
        if self._start is not None:
            session.go(self._start, remember=False)
        self.timeline.empty = session.nothing if session.empty else ""
        self._show_header()
        self.call_after_refresh(self._after_first)

    def _after_first(self) -> None:
        self._show_rows(centre=True)
        self._show_lanes()
        self.call_after_refresh(self._after_second)

    def _after_second(self) -> None:
        self._show_inspector()
        self._show_values()
        self.busy = False
        self.first_shown()
        self.look_through()
        comparison = self.session.comparison
        if comparison is not None and not comparison.identical:
            self.run_worker(self._explain, group="diff", thread=True, exit_on_error=False)

    def first_shown(self) -> None:
        """Do what was asked for at the start, once the first screen is there."""

    def look_through(self) -> None:
        """Read the runs in the background for what lanes, log and overview show."""
        overview = self.overview
        steps = () if overview is None else self.session.survey()
        walk(self, "lanes", chain(steps, self.session.look_through()), self._looked, at_once_s=0)

    def _looked(self, _: float | None, done: bool) -> None:
        self._show_lanes()
        if self.overview is not None:
            self.overview.update_lines()

    @property
    def overview(self) -> OverviewScreen | None:
        return next((one for one in self.screen_stack if isinstance(one, OverviewScreen)), None)

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
        while not comparison.runs.done and not worker.is_cancelled:
            try:
                block = comparison.runs.fetch()
            except RsltraceError as error:
                self.call_from_thread(self.notify, str(error), severity="error")
                return
            # On the app's thread: the view must not change while a screen is drawn from it.
            self.call_from_thread(self.session.take_block, block)
            if comparison.runs.done or perf_counter() - shown > _REPORT_S:
                self.call_from_thread(self._show_rows)
                shown = perf_counter()

    def _explained(self) -> None:
        self._show_header()
        self._show_inspector(top=False)

    @property
    def timeline(self) -> Timeline:
        return self.screen_stack[0].query_one(Timeline)

    @property
    def inspector(self) -> Inspector:
        return self.screen_stack[0].query_one(Inspector)

    @property
    def source(self) -> SourceView:
        return self.screen_stack[0].query_one(SourceView)

    @property
    def lanes(self) -> LanesView:
        return self.screen_stack[0].query_one(LanesView)

    def _fit(self, width: int, height: int) -> None:
        screen = self.screen_stack[0]
        screen.set_class(width >= WIDE, "wide")
        screen.set_class(height < 16, "low")
        screen.set_class(height < 11 or (width < WIDE and height < 14), "lowest")
        labels = self.session.lane_window.labels(self.session.view)
        two, colours = self.session.b is not None, self.session.node_colours
        self.lanes.fit_labels(labels, width, colours, two=two)
        rows = min(len(labels), max(4, height // 5))
        self._more_lanes = max(1 - rows, min(self._more_lanes, len(labels) - rows))
        self.lanes.styles.height = rows + self._more_lanes + 1
        if self._share:
            shares = f"{self._share}fr", f"{SHARES - self._share}fr"
            detail = screen.query_one("#detail")
            for widget, share in zip((self.timeline, detail), shares, strict=True):
                widget.styles.width = share if width >= WIDE else "1fr"
                widget.styles.height = "1fr" if width >= WIDE else share

    # Drawing.

    def _show_header(self, size: Size | None = None) -> None:
        session, size = self.session, size or self.size
        verdict, bad = "", False
        if session.comparison is not None:
            verdict, bad = session.comparison.verdict(), not session.comparison.identical
        self.screen_stack[0].query_one(HeaderBar).show(
            session.title(),
            session.facts(),
            self._mode(),
            verdict,
            bad=bad,
            lines=verdict_lines(size.height),
            width=size.width,
        )

    def _mode(self) -> str:
        following = "following, " if self.following else ""
        return f"{following}{self.session.mode()}"

    def _show_values(self) -> None:
        """Read what the rows in sight say of messages, and show it once it is there."""
        steps = self.session.read_values(self.timeline.in_sight)
        walk(self, "values", steps, self._values_arrived, at_once_s=_EFFECTS_AT_ONCE_S)

    def _values_arrived(self, _: int | None, done: bool) -> None:
        self.timeline.redraw()

    def _show_rows(self, *, centre: bool = False) -> None:
        timeline, session = self.timeline, self.session
        timeline.show(session.row, session.rows.count, session.columns(timeline.row_width))
        if session.rows.count:
            timeline.go(session.row_of_place(), centre=centre)
        self._show_footer()

    def _show_lanes(self) -> None:
        lanes, session = self.lanes, self.session
        if not lanes.size.width:
            return
        made, position = session.lanes(lanes.columns)
        first, divergences = None, frozenset[int]()
        if session.comparison is not None:
            found = session.comparison.divergences_in(session.view, made.window, made.columns)
            first, divergences = found
        lanes.show(
            made, position, own=session.own_lane(), divergence=first, divergences=divergences
        )

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

    def _show_source(self) -> None:
        """Show the text of the callback, if that is wanted. Files are read in a thread."""
        here = self.session.current()
        if here is not None and self.screen_stack[0].has_class("with-source"):

            def arrive(found: list[CallbackCode | None] | None, done: bool) -> None:
                if self.session.current() == here:
                    self.source.show(found[0] if found else None)

            walk(self, "source", ([source_of(*here)] for _ in range(1)), arrive, at_once_s=0)

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
            following = "following  " if self.following else ""
            status = f"{following}{session.place + 1:,}/{session.view.count:,}"
        searching = "match" if session.search is not None else "divergence" if session.b else ""
        self.screen_stack[0].query_one(FooterBar).show(
            two=session.b is not None, searching=searching, status=status, live=self.live
        )

    def _say(self, status: str) -> None:
        self._status = status
        self._show_footer()

    def go(self, place: int, *, remember: bool = True, centre: bool = False) -> None:
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
        if self._soon is not None:
            self._soon.cancel()
        self._call_in(_INSPECT_S, self._inspect)

    def _call_in(self, delay_s: float, callback: Callable[[], None]) -> None:
        # Not set_timer: where a busy machine makes Textual's timer start later than its delay, it
        # counts the one call that it has to make as one it has missed.
        loop = asyncio.get_running_loop()
        self._soon = loop.call_later(delay_s, self.call_next, callback)

    def _inspect(self) -> None:
        # Whatever is selected now: the comparison may have given the event another place.
        if self.screen_stack:
            self._show_inspector()
            self._call_in(_VALUES_S, self._complete)

    def _complete(self) -> None:
        if self.screen_stack:
            self._show_values()
            self._show_source()
            self.busy = False
            self.rested()

    def rested(self) -> None:
        """Tell others where one has stopped for a moment."""

    def on_resize(self, event: events.Resize) -> None:
        """Use the new size, which the app and its parts will have a moment later."""
        self._fit(event.size.width, event.size.height)
        self._show_header(event.size)
        self.call_after_refresh(self._redraw)

    def on_timeline_resized(self) -> None:
        self._show_rows()
        if not self.busy:
            self._show_values()

    def on_timeline_scrolled(self) -> None:
        self._show_values()

    def on_lanes_view_resized(self) -> None:
        self._show_lanes()

    def _redraw(self) -> None:
        self._show_rows()
        self._show_lanes()
