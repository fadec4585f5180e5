"""The screen of bags and native recordings: topics, their messages, the message; of two as well."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Container
from textual.content import Content
from textual.geometry import Size
from textual.widget import Widget
from textual.widgets import Static

from rsltrace.diff.row_sign import RowSign
from rsltrace.job.values.times import TimeError, TimeInRun, parse_time_in_run
from rsltrace.trace.model.texts import printable
from rsltrace_viewer.model.inspector.message_tree import Line
from rsltrace_viewer.model.query.parser import complete
from rsltrace_viewer.model.query.tokens import QueryError
from rsltrace_viewer.model.recordings.filter import FIELDS, choices, read_filter
from rsltrace_viewer.model.recordings.plots import RecordingPlots
from rsltrace_viewer.model.recordings.recording import Recording
from rsltrace_viewer.model.recordings.session import RecordingSession
from rsltrace_viewer.model.view import cells, fit
from rsltrace_viewer.terminal.base import BaseApp
from rsltrace_viewer.terminal.follow import walk
from rsltrace_viewer.terminal.keys import COMPARE, FIND, LOOK, MOVE, Key
from rsltrace_viewer.terminal.screens.help import KeysScreen
from rsltrace_viewer.terminal.screens.plot import PlotScreen
from rsltrace_viewer.terminal.widgets.bars import HeaderBar, verdict_lines
from rsltrace_viewer.terminal.widgets.inspector import Inspector
from rsltrace_viewer.terminal.widgets.list_view import ListView, Pieces
from rsltrace_viewer.terminal.widgets.prompt import Prompt, Question

RECORDING_KEYS: tuple[Key, ...] = (
    Key("down,j", "↓ j", "", "next line", MOVE, "next", 1),
    Key("up,k", "↑ k", "", "previous line", MOVE),
    Key("pagedown,space", "PgDn Space", "", "a page on; PgUp back, Home and End", MOVE),
    Key("tab", "Tab", "pane(1)", "next pane: topics, messages, message", LOOK, "pane", 2),
    Key("shift+tab", "⇧Tab", "pane(-1)", "previous pane", LOOK),
    Key("enter", "Enter", "", "to the messages of a topic; open a field", LOOK, "open", 3),
    Key("t", "t", "ask('time')", "go to a time since the start", FIND, "time", 6),
    Key("slash", "/", "ask('search')", "search: a word, or as in a filter", FIND, "search", 4),
    Key("F", "F", "ask('filter')", "show only some messages: topic:/x …", FIND, "filter", 5),
    Key("n", "n", "next_match(1)", "next match; without a search, difference", FIND),
    Key("N", "N", "next_match(-1)", "previous match or difference", FIND),
    Key("v", "v", "report", "how the recordings compare: the report", COMPARE, "why", 3, True),
    Key("p", "p", "plot", "plot fields and rates", LOOK, "plot", 4),
    Key("y", "y", "yank", "copy the line one is at", LOOK),
    Key("d", "d", "theme", "dark or light", LOOK),
    Key("escape", "Esc", "escape", "end search, filter; back to the topics", LOOK),
    Key("question_mark", "?", "help", "all keys", LOOK, "help", 0),
    Key("q", "q", "quit", "quit", LOOK, "quit", 0),
)


def recording_keys(*, two: bool) -> list[Key]:
    """Return the keys that do something with one recording, or with two."""
    return [key for key in RECORDING_KEYS if two or not key.two]


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


# What is asked about recordings, and which answers are good: a search, a filter, a time.


def question_of(kind: str, session: RecordingSession) -> Question:
    """Return the question of a kind: ``search``, ``filter`` or ``time``."""
    recordings = session.recordings
    known = choices(recordings)

    def check(text: str) -> object:
        return read_filter(text, recordings)

    def completed(text: str) -> list[str]:
        return complete(text, known)

    fields = "topic: type: time: text: …"
    questions = {
        "search": Question(
            "search",
            "search",
            f"a word, or {fields} as in a filter; Enter finds the next",
            "",
            check,
            completed,
        ),
        "filter": Question(
            "filter",
            "filter",
            f"{fields}  Tab completes, empty shows all",
            session.filter_text,
            check,
            completed,
        ),
        "time": Question("time", "go to", "seconds after the start, or 2ms", "", parse_time_in_run),
    }
    return questions[kind]


class RecordingApp(BaseApp):
    BINDINGS: ClassVar = [
        Binding(key.keys, key.action, key.help, show=False, priority=key.first)
        for key in RECORDING_KEYS
        if key.action
    ]
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

    def __init__(
        self,
        session: RecordingSession,
        *,
        light: bool = False,
        start: tuple[int | None, TimeInRun] | None = None,
        filter_text: str = "",
    ) -> None:
        """Show ``session``, of which nothing needs to be read yet; once it is read at ``start``:
        the number of a message, or a time."""
        super().__init__(light=light)
        self.session = session
        self._start = start
        self._first_filter = filter_text
        self._moved = False
        self._status = ""
        self.filtering = ""
        """What to say of the filter."""

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

    @property
    def topics(self) -> ListView:
        return self.screen_stack[0].query_one("#topics", ListView)

    @property
    def messages(self) -> ListView:
        return self.screen_stack[0].query_one("#messages", ListView)

    @property
    def message(self) -> Inspector:
        return self.screen_stack[0].query_one(Inspector)

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

    # Moving.

    def on_list_view_moved(self, event: ListView.Moved) -> None:
        self._moved = True
        session = self.session
        if self.focused is self.topics:
            if session.place != event.line:
                session.place, session.row = event.line, 0
                self._show_messages()
                self.topics.refresh()
        else:
            session.row = event.line
            self.messages.refresh()
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
        self._toggle(event.line)

    def _toggle(self, line: Line) -> None:
        if line.open is not None:
            self.session.openness.toggle(line.path)
            self._show_message()

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """While one types, keys are text."""
        return not (action in ("ask", "pane") and self.prompt.asking)

    def action_pane(self, step: int) -> None:
        panes: list[Widget] = [self.topics, self.messages, self.message]
        place = panes.index(self.focused) if self.focused in panes else -step
        panes[(place + step) % len(panes)].focus()

    def action_escape(self) -> None:
        """End the nearest thing that can be ended, or go back to the topics."""
        session = self.session
        if self.prompt.asking:
            self.prompt.put_aside()
        elif self.has_worker("seek"):
            self.workers.cancel_group(self, "seek")
            self._say("stopped")
        elif self.has_worker("filter"):
            self._filter("")
        elif self.focused is not self.topics:
            self.topics.focus()
        elif session.search_text:
            session.set_search("")
            self._say("")
        elif session.filter_text:
            self._filter("")

    def action_ask(self, kind: str) -> None:
        if kind != "time" and not self.session.done:
            self._say("still reading: a moment, please")
        else:
            self.prompt.ask(question_of(kind, self.session))

    def on_prompt_answered(self, event: Prompt.Answered) -> None:
        if event.text is None:
            self.topics.focus()
        elif event.kind == "filter":
            self.topics.focus()
            self._filter(event.text)
        else:
            self.messages.focus()
            if event.kind == "search":
                self.session.set_search(event.text)
                if event.text.strip():
                    self.action_next_match(1)
            elif event.text.strip():
                try:
                    self.session.go_to_time(parse_time_in_run(event.text))
                except TimeError as error:
                    self._say(str(error))
                else:
                    self._say("")
                    self._show_messages()

    def first_read(self) -> None:
        if self._start is not None:
            try:
                beyond = self.session.go_to_message(*self._start)
            except TimeError as error:
                beyond = str(error)
            if beyond:
                self.notify(beyond, severity="warning")
        elif not self._moved:
            self.session.go_to_difference()
        self.topics.cursor = self.session.place
        if self._first_filter and not self.session.damage:
            try:
                self._filter(self._first_filter)
            except QueryError as error:  # a time that is not in it
                self.notify(f"{self._first_filter}: {error}", severity="error")

    def _filter(self, text: str) -> None:
        session = self.session
        self.workers.cancel_group(self, "filter")
        steps = session.set_filter(text)
        total = max(sum(recording.count for recording in session.recordings), 1)

        def arrive(looked: int | None, done: bool) -> None:
            session.show_found()
            self.topics.cursor = session.place
            part = "" if done else f" ({(looked or 0) / total:.0%} read, Esc ends it)"
            self._status = ""
            self.filtering = f"filter: {session.found_count:,} messages{part}" if text else ""
            self._show_all()

        walk(self, "filter", steps, arrive)

    def action_next_match(self, step: int) -> None:
        """Go to the next match of the search; without one, to the next difference."""
        session = self.session
        which = "later" if step > 0 else "earlier"
        if not session.search_text:
            if not session.two:
                self._say("nothing is searched: / searches")
                return
            found = session.pairs.next_difference(session.row, step)
            if found is None:
                self._say(f"no {which} difference on this topic")
            else:
                self._go(session.place, found)
            return
        total = max(sum(recording.count for recording in session.recordings), 1)

        def arrive(found: tuple[int, int] | int | None, done: bool) -> None:
            if isinstance(found, tuple):
                self._go(*found)
            elif done:
                self._say(f"no match of {session.search_text}")
            elif found is not None:
                share = min(found / total, 1)
                said = f"looking for the {'next' if step > 0 else 'previous'} match"
                self._say(f"{said} of {session.search_text} … {share:.0%}, Esc stops")

        walk(self, "seek", session.seek(step), arrive)

    def _go(self, place: int, row: int) -> None:
        self._moved = True
        self.session.place, self.session.row = place, row
        self.topics.cursor = place
        self.messages.focus()
        self._status = ""
        self._show_all()

    # Looking.

    def action_plot(self) -> None:
        self.push_screen(PlotScreen(RecordingPlots(self.session)))

    def action_report(self) -> None:
        from rsltrace_viewer.terminal.screens.report import ReportScreen

        if self.session.diff is None:
            self._say("still comparing …")
        else:
            self.push_screen(ReportScreen(self.session.diff))

    def action_yank(self) -> None:
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

    def action_help(self) -> None:
        self.push_screen(KeysScreen(recording_keys(two=self.session.two), FIELDS))


def open_recordings(paths: tuple[Path, ...]) -> RecordingSession:
    """Open one or two recordings. Raises BagError, TraceError."""
    return RecordingSession(*(Recording(path) for path in paths))
