"""The screen of recordings: topics, their messages, the message; two recordings side by side."""

from __future__ import annotations

from typing import Any

from textual import events
from textual.app import App, ComposeResult
from textual.containers import Container
from textual.content import Content
from textual.geometry import Size
from textual.widgets import Static

from rsltrace.diff.row_sign import RowSign
from rsltrace.trace.model.texts import printable
from rsltrace_viewer.model.inspector.message_tree import Line
from rsltrace_viewer.model.recordings.session import RecordingSession
from rsltrace_viewer.model.view import cells, fit
from rsltrace_viewer.terminal.follow import walk
from rsltrace_viewer.terminal.recordings.keys import recording_keys
from rsltrace_viewer.terminal.widgets.bars import HeaderBar, verdict_lines
from rsltrace_viewer.terminal.widgets.inspector import Inspector
from rsltrace_viewer.terminal.widgets.list_view import ListView, Pieces
from rsltrace_viewer.terminal.widgets.prompt import Prompt

_WIDE = 110
_WIDE_OF_TWO = 170
_TOPICS_LEAST = 3
_TIME = 12
_STYLES = {
    RowSign.MATCH: "muted",
    RowSign.DIFFERS: "error",
    RowSign.ONLY_A: "warning",
    RowSign.ONLY_B: "good",
}


class RecordingShell(App[None]):
    """One or two recordings, read in the background while one looks at them. What keys do is added
    by a subclass."""

    TITLE = "rsltrace view"
    ENABLE_COMMAND_PALETTE = False
    CSS = """
    Screen { layout: vertical; overflow: hidden; }
    #body { height: 1fr; layout: vertical; }
    ListView { border-top: solid $panel; border-title-color: $text-muted; }
    ListView:focus { border-top: heavy $primary; border-title-color: $text; }
    #lists { height: 3fr; width: 1fr; layout: vertical; }
    #message { height: 2fr; width: 1fr; }
    #footer { height: 1; background: $panel; padding: 0 1; }
    .wide #body { layout: horizontal; }
    .wide #lists { height: 1fr; width: 3fr; }
    .wide #message { height: 1fr; width: 2fr; border-left: solid $panel; }
    """

    def __init__(self, session: RecordingSession, *, light: bool = False) -> None:
        """Show ``session``, of which nothing needs to be read yet."""
        super().__init__()
        self.session = session
        self.busy = True
        """Whether something is about to be read or drawn: for pictures and tests."""
        self.theme = "textual-light" if light else "textual-dark"
        self._moved = False
        self._status = ""
        self.filtering = ""
        """What to say of the filter."""

    def notify(self, message: str, **more: Any) -> None:
        """Show a message in a corner: what is in it may come from a file."""
        super().notify(printable(message), markup=False, **more)

    def compose(self) -> ComposeResult:
        yield HeaderBar(id="header")
        with Container(id="body"):
            with Container(id="lists"):
                yield ListView(id="topics")
                yield ListView(id="messages")
            yield Inspector(id="message")
        yield Prompt(id="prompt")
        yield Static(id="footer")

    def on_mount(self) -> None:
        self.topics.focus()
        self._fit(self.size)
        self._show_all()
        walk(self, "read", self.session.read(), self._read, at_once_s=0)

    def _read(self, _: int | None, done: bool) -> None:
        if done:
            self.first_read()
            self.busy = False
        self._show_all()

    def first_read(self) -> None:
        """Do what was asked for at the start, once all is read."""

    @property
    def topics(self) -> ListView:
        return self.screen_stack[0].query_one("#topics", ListView)

    @property
    def messages(self) -> ListView:
        return self.screen_stack[0].query_one("#messages", ListView)

    @property
    def message(self) -> Inspector:
        return self.screen_stack[0].query_one(Inspector)

    @property
    def prompt(self) -> Prompt:
        return self.screen_stack[0].query_one(Prompt)

    # Drawing.

    def _fit(self, size: Size) -> None:
        wide = _WIDE_OF_TWO if self.session.two else _WIDE
        self.screen_stack[0].set_class(size.width >= wide, "wide")
        most = max(size.height // 3, _TOPICS_LEAST)
        self.topics.styles.height = min(len(self.session.keys), most) + 1

    def on_resize(self, event: events.Resize) -> None:
        self._fit(event.size)
        self.call_after_refresh(self._show_all)

    def _show_all(self) -> None:
        session = self.session
        verdict, bad = session.verdict()
        self.screen_stack[0].query_one(HeaderBar).show(
            session.title(),
            session.facts(),
            session.mode(),
            verdict,
            bad=bad,
            lines=max(verdict_lines(self.size.height), 1),
            width=self.size.width,
        )
        self.topics.show(self._topic, len(session.keys))
        both = " of a, of b" if session.two else ""
        self.topics.border_title = f" topics: messages, rate{both} "
        self._show_messages()
        self._show_footer()

    def _show_messages(self) -> None:
        messages, session = self.messages, self.session
        messages.cursor = session.row
        messages.show(self._message, session.pairs.count)
        topic = session.topic_text(session.place)[0] if session.keys else "no topic"
        values = "values of a │ of b" if session.two else "values"
        messages.border_title = Content(f" {topic}: number, time in s, {values} ")
        messages.call_after_refresh(messages.scroll_to_cursor)
        self._show_message()

    def _show_message(self) -> None:
        place = self.session.place, self.session.row

        def arrive(lines: list[Line] | None, done: bool) -> None:
            if place == (self.session.place, self.session.row):
                self.message.show(lines or [], top=False)

        walk(self, "message", self.session.lines(), arrive)

    def _topic(self, place: int) -> Pieces:
        name, type_name, counts, differ = self.session.topic_text(place)
        width = max(self.topics.size.width - 4, 20)
        numbers = "".join(f"{text:>19}" for text in counts)
        room = width - cells(numbers) - 2
        both = f"{name}  {type_name}" if room > cells(name) + cells(type_name) + 2 else name
        sign = "≠ " if differ else "  "
        style = "error" if differ else "plain"
        lead = ">" if place == self.session.place else " "
        return (
            (lead, "title"),
            (sign, style),
            (fit(both, max(room, 8)), style),
            (numbers, "muted"),
        )

    def _message(self, row: int) -> Pieces:
        time, sign, texts = self.session.message_text(row)
        lead = (">" if row == self.session.row else " ", "title")
        head = (f"{self.session.number_of(row):>6} {time:>{_TIME}} ", "muted")
        if sign is None:
            return (lead, head, (texts[0], "plain"))
        style = _STYLES[sign]
        room = max((self.messages.size.width - _TIME - 15) // 2, 8)
        both = [(fit(text, room), "plain" if sign is RowSign.MATCH else style) for text in texts]
        return (lead, head, (f"{sign.value} ", style), both[0], (" │ ", "muted"), both[1])

    def _show_footer(self) -> None:
        parts: list[Content | tuple[str, str] | str] = []
        session = self.session
        status = printable(self._status or self.filtering)
        room = self.size.width - 3 - cells(status)
        found = sorted(
            (k for k in recording_keys(two=session.two) if k.short), key=lambda k: k.rank
        )
        entries = [("↓↑" if key.short == "next" else key.shown, key.short) for key in found]
        if session.search_text or session.two:
            entries.insert(3, ("n N", "match" if session.search_text else "differs"))
        for shown, words in entries:
            room -= cells(shown) + cells(words) + 3
            if room > 0:
                parts += [(shown, "bold $text-primary"), f" {words}  "]
        parts.append((status, "bold"))
        self.screen_stack[0].query_one("#footer", Static).update(Content.assemble(*parts))

    def _say(self, status: str) -> None:
        self._status = status
        self._show_footer()
