"""A list of lines with a cursor. Only the lines on screen are made, however long the list is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

from rich.segment import Segment as Piece
from rich.style import Style
from textual import events
from textual.binding import Binding, BindingType
from textual.geometry import Size
from textual.message import Message
from textual.scroll_view import ScrollView
from textual.strip import Strip
from textual.widgets import OptionList

from rsltrace_viewer.terminal.widgets.bars import line_of, node_style, set_virtual_size

STYLES = ("plain", "muted", "title", "good", "error", "warning", "link", "bar")
Pieces = Sequence[tuple[str, str]]
"""Texts of a line, each with one of STYLES, or that of ``node_piece``. They must be printable."""
_NODE = "node-"


def node_piece(text: str, colour: int | None) -> tuple[str, str]:
    """Return a text in the colour of a node, if that has one."""
    return text, "plain" if colour is None else f"{_NODE}{colour}"


class Choices(OptionList):
    """A list of options that ``j`` and ``k`` move in as well."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("j", "cursor_down", show=False),
        Binding("k", "cursor_up", show=False),
    ]


class ListView(ScrollView, can_focus=True, inherit_bindings=False):
    """Lines that somebody else provides. It moves by the usual keys; Enter and clicks choose."""

    COMPONENT_CLASSES: ClassVar[set[str]] = {f"list--{name}" for name in (*STYLES, "cursor")}
    DEFAULT_CSS = """
    ListView { background: $background; scrollbar-size: 1 1; overflow-x: hidden;
               overflow-y: scroll; height: 1fr; width: 1fr; padding: 0 0 0 1; }
    ListView > .list--plain { color: $text; }
    ListView > .list--muted { color: $text-muted; }
    ListView > .list--title { color: $text; text-style: bold underline; }
    ListView > .list--good { color: $text-success; }
    ListView > .list--error { color: $text-error; text-style: bold; }
    ListView > .list--warning { color: $text-warning; }
    ListView > .list--link { color: $text-primary; }
    ListView > .list--bar { color: $text-primary; }
    ListView > .list--cursor { background: $primary 30%; }
    """

    class Moved(Message):
        def __init__(self, line: int) -> None:
            super().__init__()
            self.line = line

    class Chosen(Message):
        """A line was chosen, by Enter or a click."""

        def __init__(self, line: int) -> None:
            super().__init__()
            self.line = line

    def __init__(self, *, id: str) -> None:  # Textual's name for it
        super().__init__(id=id)
        self.cursor = 0
        self._source: Callable[[int], Pieces] = lambda line: ()
        self.count = 0

    @property
    def page(self) -> int:
        return max(self.scrollable_content_region.height, 1)

    def show(self, source: Callable[[int], Pieces], count: int) -> None:
        """Show ``count`` lines; the cursor stays where it is if there is such a line."""
        self._source, self.count = source, count
        set_virtual_size(self, Size(max(self.size.width, 1), count))
        self.cursor = max(min(self.cursor, count - 1), 0)
        self.refresh()

    def go(self, line: int) -> None:
        """Move the cursor to a line, and bring it into sight."""
        self.cursor = max(min(line, self.count - 1), 0)
        top = round(self.scroll_y)
        if not top <= self.cursor < top + self.page:
            above = self.cursor < top
            wanted = self.cursor if above else self.cursor - self.page + 1
            self.scroll_to(y=max(wanted, 0), animate=False, force=True, immediate=True)
        self.refresh()
        self.post_message(self.Moved(self.cursor))

    def scroll_to_cursor(self) -> None:
        if not round(self.scroll_y) <= self.cursor < round(self.scroll_y) + self.page:
            wanted = max(self.cursor - self.page // 2, 0)
            self.scroll_to(y=wanted, animate=False, force=True, immediate=True)

    def on_key(self, event: events.Key) -> None:
        steps = {
            "down": 1,
            "j": 1,
            "up": -1,
            "k": -1,
            "pagedown": self.page,
            "space": self.page,
            "pageup": -self.page,
            "home": -self.count,
            "end": self.count,
            "G": self.count,
        }
        if event.key in steps:
            self.go(self.cursor + steps[event.key])
        elif event.key == "enter" and self.count:
            self.post_message(self.Chosen(self.cursor))
        else:
            return
        event.stop()

    def on_click(self, event: events.Click) -> None:
        place = event.get_content_offset(self)
        line = round(self.scroll_y) + (place.y if place is not None else self.count)
        if line < self.count:
            self.go(line)
            self.post_message(self.Chosen(line))

    def _style(self, name: str) -> Style:
        if name.startswith(_NODE):
            colour = int(name.removeprefix(_NODE))
            return self._style("plain") + node_style(self, colour)
        return self.get_component_rich_style(f"list--{name}")

    def render_line(self, y: int) -> Strip:
        line = round(self.scroll_y) + y
        width = self.scrollable_content_region.width
        if line >= self.count:
            return Strip([Piece(" " * width, self._style("plain"))], width)
        pieces = [Piece(text, self._style(name)) for text, name in self._source(line)]
        over = self._style("cursor") if self.has_focus and line == self.cursor else None
        return line_of(pieces, width, self._style("plain"), more=self._style("muted"), over=over)
