"""What to open when no trace was named: the traces of the folder, the newest first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.content import Content
from textual.widgets import OptionList, Static
from textual.widgets.option_list import Option

from rsltrace.errors import RsltraceError
from rsltrace.model.printable import printable
from rsltrace.model.stamp import format_duration
from rsltrace.trace.reader import Trace

_LOOKED_AT_MAX = 200
_FOLDERS_DEEP = ("*.mcap", "*/*.mcap")


@dataclass(frozen=True, slots=True)
class Found:
    """A trace of the folder."""

    path: Path
    events: int
    duration_ns: int
    digest: str
    complete: bool

    @property
    def text(self) -> str:
        """One line about it."""
        state = "" if self.complete else "  not finished"
        return (
            f"{printable(str(self.path))}  {self.events:,} events  "
            f"{format_duration(self.duration_ns)}  {self.digest}{state}"
        )


def traces_in(folder: Path) -> list[Found]:
    """Return the traces in a folder and the folders in it, the newest first. Others are left out:
    recordings that are no traces, and what cannot be read."""
    paths = [path for pattern in _FOLDERS_DEEP for path in folder.glob(pattern) if path.is_file()]
    paths.sort(key=lambda path: (-path.stat().st_mtime, str(path)))
    found = []
    for path in paths[:_LOOKED_AT_MAX]:
        try:
            with Trace.open(path) as trace:
                length = trace.end_ns - trace.start_ns
                found.append(Found(path, trace.event_count, length, trace.digest, trace.complete))
        except RsltraceError:
            continue
    return found


class ChooseApp(App[list[Path]]):
    """Returns one path, or two to compare."""

    TITLE = "rsltrace view"
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q,escape", "quit", "quit"),
        Binding("space", "mark", "choose two to compare"),
        Binding("j", "move(1)", show=False),
        Binding("k", "move(-1)", show=False),
    ]
    CSS = """
    Static { padding: 0 1; background: $panel; }
    OptionList, OptionList:focus { height: 1fr; border: none; }
    """

    def __init__(self, found: Sequence[Found]) -> None:
        super().__init__()
        self._found = found
        self._marked: list[int] = []

    def compose(self) -> ComposeResult:
        """Make the list."""
        yield Static("Traces of this folder: which one?")
        yield OptionList(*(Option(Content(self._text(i))) for i in range(len(self._found))))
        yield Static("Enter opens   Space marks one to compare with   q quits")

    def on_mount(self) -> None:
        """Take the first."""
        self.query_one(OptionList).highlighted = 0

    def _text(self, place: int) -> str:
        mark = f"[{'ab'[self._marked.index(place)]}]" if place in self._marked else "   "
        return f"{mark} {self._found[place].text}"

    def action_mark(self) -> None:
        """Mark or unmark."""
        options = self.query_one(OptionList)
        place = options.highlighted
        if place is None:
            return
        if place in self._marked:
            self._marked.remove(place)
        else:
            self._marked = [*self._marked[-1:], place]
        for number in range(len(self._found)):
            options.replace_option_prompt_at_index(number, Content(self._text(number)))

    def action_move(self, step: int) -> None:
        """Move in the list."""
        options = self.query_one(OptionList)
        options.action_cursor_down() if step > 0 else options.action_cursor_up()

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Open what is marked; the one under the cursor, too."""
        places = list(self._marked)
        if event.option_index not in places:
            places.append(event.option_index)
        self.exit([self._found[place].path for place in places[:2]])
