"""What to open when nothing was named: the traces and recordings of the folder, newest first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.content import Content
from textual.widgets import OptionList, Static
from textual.widgets.option_list import Option

from rsltrace_viewer.model.cells import cells, fit
from rsltrace_viewer.model.folder import Found

_MARK = 4
_FRAME = 4


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

    def __init__(self, found: Sequence[Found], *, light: bool = False) -> None:
        super().__init__()
        self._found = found
        self._marked: list[int] = []
        self.theme = "textual-light" if light else "textual-dark"

    def compose(self) -> ComposeResult:
        """Make the list."""
        yield Static("Traces and recordings of this folder: which one?")
        yield OptionList(*(Option(Content(self._text(i))) for i in range(len(self._found))))
        yield Static("Enter opens   Space marks one to compare with   q quits")

    def on_mount(self) -> None:
        """Take the first."""
        self.query_one(OptionList).highlighted = 0

    def on_resize(self) -> None:
        """Use the width there is."""
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
        """Mark or unmark."""
        place = self.query_one(OptionList).highlighted
        if place is None:
            return
        if place in self._marked:
            self._marked.remove(place)
        else:
            self._marked = [*self._marked[-1:], place]
        self._show()

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
