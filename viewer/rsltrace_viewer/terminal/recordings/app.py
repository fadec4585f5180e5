"""Bags on the screen: what keys, clicks and answers change."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from textual import events
from textual.binding import Binding
from textual.widget import Widget

from rsltrace.job.values.times import TimeError, TimeInRun, parse_time_in_run
from rsltrace.trace.model.texts import printable
from rsltrace_viewer.model.inspector.message_tree import Line
from rsltrace_viewer.model.query.parser import complete
from rsltrace_viewer.model.query.tokens import QueryError
from rsltrace_viewer.model.recordings.filter import FIELDS, choices, read_filter
from rsltrace_viewer.model.recordings.plots import RecordingPlots
from rsltrace_viewer.model.recordings.recording import Recording
from rsltrace_viewer.model.recordings.session import RecordingSession
from rsltrace_viewer.terminal.follow import walk
from rsltrace_viewer.terminal.recordings.keys import RECORDING_KEYS, recording_keys
from rsltrace_viewer.terminal.recordings.shell import RecordingShell
from rsltrace_viewer.terminal.screens.help import KeysScreen
from rsltrace_viewer.terminal.screens.plot import PlotScreen
from rsltrace_viewer.terminal.widgets.inspector import Inspector
from rsltrace_viewer.terminal.widgets.list_view import ListView
from rsltrace_viewer.terminal.widgets.prompt import Prompt, Question

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


class RecordingApp(RecordingShell):
    BINDINGS: ClassVar = [
        Binding(key.keys, key.action, key.help, show=False, priority=key.first)
        for key in RECORDING_KEYS
        if key.action
    ]

    def __init__(
        self,
        session: RecordingSession,
        *,
        light: bool = False,
        start: tuple[int | None, TimeInRun] | None = None,
        filter_text: str = "",
    ) -> None:
        """Show ``session``, once it is read at ``start``: the number of a message, or a time."""
        super().__init__(session, light=light)
        self._start = start
        self._first_filter = filter_text

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
        elif any(w.group == "seek" and w.is_running for w in self.workers):
            self.workers.cancel_group(self, "seek")
            self._say("stopped")
        elif any(w.group == "filter" and w.is_running for w in self.workers):
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
            self.session.go_to_message(*self._start)
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

    def action_theme(self) -> None:
        self.theme = "textual-dark" if self.theme == "textual-light" else "textual-light"

    def action_help(self) -> None:
        self.push_screen(KeysScreen(recording_keys(two=self.session.two), FIELDS))

    async def action_quit(self) -> None:
        self.workers.cancel_all()
        self.exit()


def open_recordings(paths: tuple[Path, ...]) -> RecordingSession:
    """Open one or two recordings. Raises BagError, TraceError."""
    return RecordingSession(*(Recording(path) for path in paths))
