"""What to open when nothing was named: the traces and recordings of the folder, newest first."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

from textual.app import App, ComposeResult, SuspendNotSupported
from textual.binding import Binding, BindingType
from textual.content import Content
from textual.widgets import OptionList, Static
from textual.widgets.option_list import Option

from rsltrace.job.values.times import format_time, parse_time_in_run
from rsltrace_viewer.model.folder import Found
from rsltrace_viewer.model.query.parser import completions
from rsltrace_viewer.model.view import cells, fit
from rsltrace_viewer.session import Session
from rsltrace_viewer.terminal.widgets.list_view import Choices
from rsltrace_viewer.terminal.widgets.prompt import Question

# What the viewer asks for, and which answers are good: a search, a filter, a time, an index.


def question_of(kind: str, session: Session) -> Question:
    """Return the question of a kind: ``search``, ``filter``, ``time`` or ``index``."""

    def check_query(text: str) -> object:
        return session.parse(text)

    def complete(text: str) -> list[str]:
        found = (completions(text, run) for run in session.runs.values())
        return list(dict.fromkeys(chain.from_iterable(found)))

    questions = {
        "search": Question(
            "search",
            "search",
            "a word, or node: topic: kind: text: … as in a filter; Enter finds the next",
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
        "time": Question(
            "time",
            "go to time",
            "seconds after the start, or 20ms, 3us; @ and a simulated time",
            "",
            _check_time(session),
        ),
        "index": Question("index", "go to event", _numbers(session), "", _check_index(session)),
    }
    return questions[kind]


def _check_time(session: Session) -> Callable[[str], object]:
    """Return a function that raises ValueError for what is no time of the runs."""

    def check(text: str) -> None:
        time = parse_time_in_run(text)
        runs = list(session.shown.values())
        stamps = [time.stamp_ns(run.base_ns, run.end_ns) for run in runs]
        if all(stamp > run.trace.end_ns for stamp, run in zip(stamps, runs, strict=True)):
            last = max(runs, key=lambda run: run.trace.end_ns)
            since_ns = 0 if time.is_absolute else last.base_ns
            end = format_time(last.trace.end_ns - since_ns)
            raise ValueError(f"the run ends at {'@' if time.is_absolute else ''}{end}")

    return check


def _check_index(session: Session) -> Callable[[str], object]:
    """Return a function that raises ValueError for what is no number of an event of the runs."""

    def check(text: str) -> None:
        name, index = parse_index(text)
        if index >= session.run_named(name).count:
            raise ValueError(f"no event {index} (events: {_numbers(session)})")

    return check


def _numbers(session: Session) -> str:
    """Return which events there are: ``0 to 99``, of two runs ``a 0 to 99, b 0 to 98``."""
    shown = session.shown.items()
    return ", ".join(
        f"{name + ' ' if len(shown) > 1 else ''}{f'0 to {run.count - 1}' if run.count else 'none'}"
        for name, run in shown
    )


def parse_index(text: str) -> tuple[str, int]:
    """Return the run (``a``, ``b``; empty: not said) and the number of an event. Raises
    ValueError."""
    cleaned = text.strip().replace(",", "").replace("_", "").lstrip("#")
    name = cleaned[:1].lower() if cleaned[:1].lower() in ("a", "b") else ""
    number = cleaned[len(name) :].strip()
    if not number.isdecimal():
        raise ValueError(f"{text!r} is no whole number")
    return name, int(number)


# Opening a file in the user's editor, while the viewer waits.

_COMMON = ("sensible-editor", "nano", "vim", "vi")
_WITH_GOTO = ("code", "codium", "code-insiders", "cursor")
_WITH_COLON = ("subl", "hx", "helix", "zed", "zeditor")


def edit(app: App[Any], path: Path, line: int) -> str:
    """Open ``path`` at ``line`` and wait for the editor; return what went wrong, or nothing."""
    try:
        editor = _editor()
    except ValueError as error:
        return f"$VISUAL or $EDITOR cannot be understood: {error}"
    if not editor:
        return "no editor: set $VISUAL or $EDITOR"
    try:
        with app.suspend():
            done = subprocess.run(command(editor, path, line), check=False)
    except SuspendNotSupported:
        return "an editor can only be opened from a terminal"
    except OSError as error:
        return f"{editor[0]}: {error.strerror or error}"
    return "" if done.returncode == 0 else f"{editor[0]} ended with {done.returncode}"


def command(editor: list[str], path: Path, line: int) -> list[str]:
    """Return the command that opens a file at a line in an editor, as that editor wants it."""
    name = Path(editor[0]).name
    if name in _WITH_GOTO:
        return [*editor, "--goto", f"{path}:{line}"]
    if name in _WITH_COLON:
        return [*editor, f"{path}:{line}"]
    return [*editor, f"+{line}", str(path)]


def _editor() -> list[str]:
    for name in ("VISUAL", "EDITOR"):
        if chosen := shlex.split(os.environ.get(name, "")):
            return chosen
    return next(([found] for name in _COMMON if (found := shutil.which(name))), [])


_MARK = 4
_FRAME = 4


class ChooseApp(App[list[Path]]):
    """Returns one path, or two to compare."""

    TITLE = "rsltrace view"
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q,escape", "quit", "quit"),
        Binding("space", "mark", "choose two to compare"),
    ]
    CSS = """
    Static { padding: 0 1; background: $panel; }
    OptionList, OptionList:focus { height: 1fr; border: none; }
    """

    def __init__(self, found: Sequence[Found], *, light: bool = False) -> None:
        super().__init__()
        self._found = found
        self._marked: list[int] = []
        self.theme = "textual-light" if light else "textual-dark"

    def compose(self) -> ComposeResult:
        yield Static("Traces and recordings of this folder: which one?")
        yield Choices(*(Option(Content(self._text(i))) for i in range(len(self._found))))
        yield Static("Enter opens   Space marks one to compare with   q quits")

    def on_mount(self) -> None:
        self.query_one(OptionList).highlighted = 0

    def on_resize(self) -> None:
        self._show()

    def _text(self, place: int) -> str:
        mark = f"[{'ab'[self._marked.index(place)]}] " if place in self._marked else ""
        columns = [(one.name, one.amount, one.length, one.what) for one in self._found]
        name, amount, length, what = (
            max(map(cells, column)) for column in zip(*columns, strict=True)
        )
        room = self.size.width - _FRAME - _MARK - amount - length - what - 3 * 2
        row = self._found[place]
        return (
            f"{fit(mark, _MARK)}{fit(row.name, min(name, max(room, 20)))}  "
            f"{fit(row.amount, amount, right=True)}  {fit(row.length, length, right=True)}  "
            f"{row.what}"
        )

    def _show(self) -> None:
        options = self.query_one(OptionList)
        for number in range(len(self._found)):
            options.replace_option_prompt_at_index(number, Content(self._text(number)))

    def action_mark(self) -> None:
        place = self.query_one(OptionList).highlighted
        if place is None:
            return
        if place in self._marked:
            self._marked.remove(place)
        else:
            self._marked = [*self._marked[-1:], place]
        self._show()

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Open what is marked; the one under the cursor, too."""
        places = list(self._marked)
        if event.option_index not in places:
            places.append(event.option_index)
        self.exit([self._found[place].path for place in places[:2]])
