"""All log records, in order of time; of two runs together. Enter goes to the event."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.content import Content
from textual.screen import Screen
from textual.widgets import Static

from rsltrace.errors import TraceError
from rsltrace.trace.model.texts import format_seconds, printable
from rsltrace_viewer.model.folder import Event
from rsltrace_viewer.model.logs import LogLine, event_of
from rsltrace_viewer.model.view import fit
from rsltrace_viewer.session import RUN_B, Session
from rsltrace_viewer.terminal.widgets.list_view import ListView, Pieces, node_piece

_LEVELS = ((0, "all"), (30, "warnings and worse"), (40, "errors"))
_NAME = 20
_AGAIN_S = 0.3


class LogScreen(Screen[Event | None]):
    """Gives the event that logged what was chosen, or None. Lists the records of what is shown."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,q,g", "dismiss(None)", "close"),
        Binding("w", "level", "level"),
        Binding("y", "yank", "copy"),
    ]
    DEFAULT_CSS = """
    LogScreen Static { background: $panel; padding: 0 1; height: 1; }
    """

    def __init__(self, session: Session) -> None:
        super().__init__()
        self._session = session
        self._level = 0
        self._lines: list[tuple[str, LogLine]] = []
        self._known = -1

    def compose(self) -> ComposeResult:
        yield Static(id="what")
        yield ListView(id="lines")
        yield Static("↑↓ choose   Enter goes to the event   w level   y copies   Esc closes")

    def on_mount(self) -> None:
        """Show what is known; the rest when it has been read."""
        self.query_one(ListView).focus()
        self.set_interval(_AGAIN_S, self._show_more)
        self._show_more(first=True)

    def _show_more(self, first: bool = False) -> None:
        if len(self._session.logs) == self._known:
            return
        self._known = len(self._session.logs)
        least, words = _LEVELS[self._level]
        self._lines = [
            (run, line)
            for run, logs in self._session.logs.items()
            if run in self._session.shown
            for line in logs.lines
            if line.record.level >= least
        ]
        self._lines.sort(key=lambda one: one[1].stamp_ns)
        view = self.query_one(ListView)
        if first:
            here = self._session.stamp()
            view.cursor = next(
                (n for n, (_, line) in enumerate(self._lines) if line.stamp_ns >= here), 0
            )
        view.show(self._row, len(self._lines))
        view.call_after_refresh(view.go, view.cursor)
        runs = 1 if self._session.b is None else 2
        known = self._session.logs.items()
        more = sum(logs.more for run, logs in known if run in self._session.shown)
        state = "" if self._known == runs else "  reading …"
        state += f"  and {more:,} more that are not kept" if more else ""
        text = f"log  {self._session.title()}  {len(self._lines):,} records  {words}{state}"
        self.query_one("#what", Static).update(Content(text))

    def _row(self, number: int) -> Pieces:
        run, line = self._lines[number]
        record = line.record
        style = "error" if record.level >= 40 else "warning" if record.level >= 30 else "plain"
        node = f"/{record.name.replace('.', '/')}"
        colour = self._session.node_colours.get(node)
        time = format_seconds(line.stamp_ns - self._session.runs[run].base_ns)[:-3]
        return (
            (f"{run} " if self._session.b is not None else "", "link"),
            (f"{time:>12} ", "muted"),
            (f"{record.level_name:<5} ", style),
            node_piece(fit(printable(record.name), _NAME) + " ", colour),
            (line.text, style),
        )

    def action_level(self) -> None:
        self._level = (self._level + 1) % len(_LEVELS)
        self._known = -1
        self._show_more(first=True)

    def action_yank(self) -> None:
        if self._lines:
            text = "".join(piece for piece, _ in self._row(self.query_one(ListView).cursor))
            self.app.copy_to_clipboard(text.strip())
            self.app.notify(f"copied: {text.strip()}")

    def on_list_view_chosen(self, event: ListView.Chosen) -> None:
        name, line = self._lines[event.line]
        session = self._session
        run = session.b if name == RUN_B and session.b is not None else session.a
        try:
            index = event_of(run, line)
        except TraceError as error:
            self.app.notify(str(error), severity="error")
            return
        if index is None:
            self.app.notify("the event that logged this is not in the trace")
        else:
            self.dismiss((name == RUN_B, index))
