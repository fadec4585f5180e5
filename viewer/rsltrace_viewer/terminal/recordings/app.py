"""Bags on the screen: topics, their messages, the message; two recordings side by side."""

from __future__ import annotations

from bisect import bisect_left
from pathlib import Path
from typing import Any, ClassVar

from textual import events
from textual.app import App, ComposeResult
from textual.binding import Binding
from textual.containers import Container
from textual.content import Content
from textual.widget import Widget
from textual.widgets import Static

from rsltrace.model.printable import printable
from rsltrace.words.times import parse_stamp
from rsltrace_viewer.model.cells import cells, fit
from rsltrace_viewer.model.inspector.lines import Line
from rsltrace_viewer.model.recordings.plots import RecordingPlots
from rsltrace_viewer.model.recordings.recording import Recording
from rsltrace_viewer.model.recordings.session import RecordingSession
from rsltrace_viewer.model.view import Sign
from rsltrace_viewer.terminal.background import walk
from rsltrace_viewer.terminal.recordings.keys import RECORDING_KEYS, recording_keys
from rsltrace_viewer.terminal.screens.help import KeysScreen
from rsltrace_viewer.terminal.screens.plot import PlotScreen
from rsltrace_viewer.terminal.widgets.bars import HeaderBar
from rsltrace_viewer.terminal.widgets.inspector import Inspector
from rsltrace_viewer.terminal.widgets.list_view import ListView, Pieces
from rsltrace_viewer.terminal.widgets.prompt import Prompt, Question

_WIDE = 110
_WIDE_OF_TWO = 170
_TIME = 12
_STYLES = {
    Sign.MATCH: "muted",
    Sign.DIFFERS: "error",
    Sign.ONLY_A: "warning",
    Sign.ONLY_B: "good",
}


class RecordingApp(App[None]):
    """One or two recordings, read in the background while one looks at them."""

    TITLE = "rsltrace view"
    ENABLE_COMMAND_PALETTE = False
    CSS = """
    Screen { layout: vertical; overflow: hidden; }
    #body { height: 1fr; layout: vertical; }
    #topics { height: 2fr; width: 1fr; }
    #messages { height: 3fr; width: 1fr; border-top: solid $panel; }
    #message { height: 3fr; width: 1fr; border-top: solid $panel; }
    #footer { height: 1; background: $panel; padding: 0 1; }
    .wide #body { layout: grid; grid-size: 2 2; grid-columns: 3fr 5fr; grid-rows: 1fr 1fr; }
    .wide #topics { row-span: 2; height: 1fr; }
    .wide #messages, .wide #message { height: 1fr; border-left: solid $panel; }
    .wide.two #body { grid-columns: 1fr 2fr; }
    #messages:focus, #message:focus { border-top: solid $accent; }
    """
    BINDINGS: ClassVar = [
        Binding(key.keys, key.action, key.help, show=False, priority=key.first)
        for key in RECORDING_KEYS
        if key.action
    ]

    def __init__(self, session: RecordingSession, *, light: bool = False) -> None:
        """Show ``session``, of which nothing needs to be read yet."""
        super().__init__()
        self.session = session
        self.busy = True
        """Whether something is about to be read or drawn: for pictures and tests."""
        self.theme = "textual-light" if light else "textual-dark"
        self._moved = False
        self._status = ""

    def notify(self, message: str, **more: Any) -> None:
        """Show a message in a corner: what is in it may come from a file."""
        super().notify(printable(message), markup=False, **more)

    def compose(self) -> ComposeResult:
        """Make the parts."""
        yield HeaderBar(id="header")
        with Container(id="body"):
            yield ListView(id="topics")
            yield ListView(id="messages")
            yield Inspector(id="message")
        yield Prompt(id="prompt")
        yield Static(id="footer")

    def on_mount(self) -> None:
        """Show the topics, and read."""
        self.topics.focus()
        self._fit(self.size.width)
        self._show_all()
        walk(self, "read", self.session.read(), self._read, at_once_s=0)

    def _read(self, _: int | None, done: bool) -> None:
        if done:
            if not self._moved:
                self.session.go_to_difference()
                self.topics.cursor = self.session.place
            self.busy = False
        self._show_all()

    @property
    def topics(self) -> ListView:
        """The list of topics."""
        return self.screen_stack[0].query_one("#topics", ListView)

    @property
    def messages(self) -> ListView:
        """The messages of the selected topic."""
        return self.screen_stack[0].query_one("#messages", ListView)

    @property
    def message(self) -> Inspector:
        """The selected message."""
        return self.screen_stack[0].query_one(Inspector)

    @property
    def prompt(self) -> Prompt:
        """The question line."""
        return self.screen_stack[0].query_one(Prompt)

    # Drawing.

    def _fit(self, width: int) -> None:
        wide = _WIDE_OF_TWO if self.session.two else _WIDE
        self.screen_stack[0].set_class(width >= wide, "wide")
        self.screen_stack[0].set_class(self.session.two, "two")

    def on_resize(self, event: events.Resize) -> None:
        """Use the new size."""
        self._fit(event.size.width)
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
            lines=2 if self.size.height >= 20 else 1,
            width=self.size.width,
        )
        self.topics.show(self._topic, len(session.keys))
        self._show_messages()
        self._show_footer()

    def _show_messages(self) -> None:
        messages, session = self.messages, self.session
        messages.cursor = session.row
        messages.show(self._message, session.pairs.count)
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
        head = (f"{row:>7} {time:>{_TIME}} ", "muted")
        if sign is None:
            return (head, (texts[0], "plain"))
        style = _STYLES[sign]
        room = max((self.messages.size.width - _TIME - 15) // 2, 8)
        both = [(fit(text, room), "plain" if sign is Sign.MATCH else style) for text in texts]
        return (head, (f"{sign.value} ", style), both[0], (" │ ", "muted"), both[1])

    def _show_footer(self) -> None:
        parts: list[Content | tuple[str, str] | str] = []
        status = printable(self._status)
        room = self.size.width - 3 - cells(status)
        found = (key for key in recording_keys(two=self.session.two) if key.short)
        for key in sorted(found, key=lambda key: key.rank):
            text = f" {key.short}  "
            shown = "↓↑" if key.short == "next" else key.shown
            room -= cells(shown) + cells(text)
            if room > 0:
                parts += [(shown, "bold $text-primary"), text]
        parts.append((status, "bold"))
        self.screen_stack[0].query_one("#footer", Static).update(Content.assemble(*parts))

    def _say(self, status: str) -> None:
        self._status = status
        self._show_footer()

    # Moving.

    def on_list_view_moved(self, event: ListView.Moved) -> None:
        """Show what is under the cursor."""
        self._moved = True
        session = self.session
        if self.focused is self.topics:
            if session.place != event.line:
                session.place, session.row = event.line, 0
                self._show_messages()
                self.topics.refresh()
        else:
            session.row = event.line
            self._show_message()

    def on_list_view_chosen(self, event: ListView.Chosen) -> None:
        """From a topic to its messages, from there to the message."""
        (self.messages if self.focused is self.topics else self.message).focus()

    def on_key(self, event: events.Key) -> None:
        """Move in the message, as in the lists."""
        message = self.message
        if self.focused is not message:
            return
        steps = {"down": 1, "j": 1, "up": -1, "k": -1, "home": -(10**9), "end": 10**9}
        steps |= {"pagedown": message.page, "space": message.page, "pageup": -message.page}
        if event.key in steps:
            message.move(steps[event.key])
        elif event.key == "enter" and message.current is not None:
            self._toggle(message.current)

    def on_inspector_chosen(self, event: Inspector.Chosen) -> None:
        """A line was clicked."""
        self._toggle(event.line)

    def _toggle(self, line: Line) -> None:
        if line.open is not None:
            self.session.openness.toggle(line.path)
            self._show_message()

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """While one types, keys are text."""
        return not (action in ("ask", "pane") and self.prompt.asking)

    def action_pane(self, step: int) -> None:
        """Go to the next pane."""
        panes: list[Widget] = [self.topics, self.messages, self.message]
        place = panes.index(self.focused) if self.focused in panes else -step
        panes[(place + step) % len(panes)].focus()

    def action_topics(self) -> None:
        """Go back to the topics."""
        self.prompt.put_aside()
        self.topics.focus()

    def action_ask(self, kind: str) -> None:
        """Ask for a time."""
        self.prompt.ask(
            Question(kind, "go to", "seconds after the start, or 20ms", "", parse_stamp)
        )

    def on_prompt_answered(self, event: Prompt.Answered) -> None:
        """Go to the first message of the topic at a time, or later."""
        self.messages.focus()
        session = self.session
        if not event.text or not session.pairs.count:
            return
        wanted = parse_stamp(event.text)
        topic = session.topics(session.keys[session.place])[0]
        if topic is not None:
            place = bisect_left(topic.stamps, session.recordings[0].start_ns + wanted)
            rows = session.pairs.a.tolist()
            place = min(place, len(topic.stamps) - 1)
            self.messages.go(rows.index(place) if place in rows else 0)

    def action_difference(self, step: int) -> None:
        """Go to the next row of this topic that differs."""
        found = self.session.pairs.next_difference(self.session.row, step)
        if found is None:
            self._say(f"no {'later' if step > 0 else 'earlier'} difference on this topic")
        else:
            self.messages.focus()
            self.messages.go(found)
            self._say("")

    # Looking.

    def action_plot(self) -> None:
        """Open the plots."""
        self.push_screen(PlotScreen(RecordingPlots(self.session)))

    def action_report(self) -> None:
        """Show the report on two recordings."""
        from rsltrace_viewer.terminal.screens.report import ReportScreen

        if self.session.diff is None:
            self._say("still comparing …")
        else:
            self.push_screen(ReportScreen(self.session.diff))

    def action_yank(self) -> None:
        """Copy the line one is at."""
        if self.focused is self.message:
            line = self.message.current
            text = "" if line is None else f"{line.label} {line.value}"
        elif self.focused is self.messages and self.session.pairs.count:
            time, _, texts = self.session.message_text(self.session.row)
            text = " ".join((time, *texts))
        else:
            name, type_name, counts, _ = self.session.topic_text(self.session.place)
            text = " ".join((name, type_name, *counts))
        if text:
            self.copy_to_clipboard(printable(text.strip()))
            self._say("copied")

    def action_theme(self) -> None:
        """Change between dark and light."""
        self.theme = "textual-dark" if self.theme == "textual-light" else "textual-light"

    def action_help(self) -> None:
        """Show all keys."""
        self.push_screen(KeysScreen(recording_keys(two=self.session.two)))

    async def action_quit(self) -> None:
        """Leave."""
        self.workers.cancel_all()
        self.exit()


def open_recordings(paths: tuple[Path, ...]) -> RecordingSession:
    """Open one or two recordings. Raises BagError, TraceError."""
    return RecordingSession(*(Recording(path) for path in paths))
