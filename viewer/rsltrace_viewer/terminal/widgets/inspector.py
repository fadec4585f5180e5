"""The selected event as a tree of lines; a line can be opened, or followed to another event."""

from __future__ import annotations

from typing import ClassVar

from rich.segment import Segment as Piece
from rich.style import Style
from textual import events
from textual.geometry import Region, Size
from textual.message import Message
from textual.scroll_view import ScrollView
from textual.strip import Strip

from rsltrace_viewer.model.inspector.message_tree import Line, Role
from rsltrace_viewer.model.view import cells, fit, wrap
from rsltrace_viewer.terminal.widgets.bars import line_of, set_virtual_size

_IN_FULL = (Role.NOTE, Role.ERROR, Role.WARNING, Role.DIFFERENCE)
_VALUE_LINES = 4
_LABEL_MAX = 24


class Inspector(ScrollView, can_focus=True, inherit_bindings=False):
    COMPONENT_CLASSES: ClassVar[set[str]] = {f"inspector--{role.value}" for role in Role} | {
        "inspector--label",
        "inspector--cursor",
    }
    DEFAULT_CSS = """
    Inspector { background: $surface; scrollbar-size: 1 1; overflow-x: hidden;
                overflow-y: scroll; padding: 0 0 0 1; border-top: solid $panel; }
    Inspector:focus { border-top: heavy $primary; }
    Inspector > .inspector--section { color: $text; text-style: bold; }
    Inspector > .inspector--label { color: $text-muted; }
    Inspector > .inspector--field { color: $text; }
    Inspector > .inspector--bytes { color: $text; }
    Inspector > .inspector--note { color: $text-muted; text-style: italic; }
    Inspector > .inspector--link { color: $text-primary; text-style: underline; }
    Inspector > .inspector--error { color: $text-error; }
    Inspector > .inspector--warning { color: $text-warning; }
    Inspector > .inspector--difference { color: $text-error; text-style: bold; }
    Inspector > .inspector--same { color: $text-muted; }
    Inspector > .inspector--cursor { background: $primary 30%; }
    """

    class Chosen(Message):
        """A line was entered or clicked."""

        def __init__(self, line: Line) -> None:
            super().__init__()
            self.line = line

    def __init__(self, *, id: str) -> None:  # Textual's name for it
        super().__init__(id=id)
        self.cursor = 0
        self._lines: list[Line] = []
        self._drawn: list[tuple[Line, str]] = []

    @property
    def lines(self) -> list[Line]:
        return self._lines

    @property
    def page(self) -> int:
        return max(self.scrollable_content_region.height, 1)

    @property
    def current(self) -> Line | None:
        return self._drawn[self.cursor][0] if self.cursor < len(self._drawn) else None

    def show(self, lines: list[Line], *, top: bool = True) -> None:
        """Show other lines; ``top`` moves to the first, otherwise the place is kept."""
        before, first = self._drawn, self.cursor
        self._lines = lines
        self._lay_out()
        moved = top and self.scroll_y > 0
        if top:
            self.cursor = 0
            self.scroll_to(y=0, animate=False, force=True, immediate=True)
        self.cursor = min(self.cursor, max(len(self._drawn) - 1, 0))
        if moved:
            self.refresh()
        else:
            self._refresh_changes(before, first)

    def move(self, step: int) -> None:
        self.cursor = max(min(self.cursor + step, len(self._drawn) - 1), 0)
        height = self.page
        if self.cursor < self.scroll_y:
            self.scroll_to(y=self.cursor, animate=False, force=True, immediate=True)
        elif self.cursor >= self.scroll_y + height:
            self.scroll_to(y=self.cursor - height + 1, animate=False, force=True, immediate=True)
        self.refresh()

    def on_resize(self, event: events.Resize) -> None:
        self._lay_out()
        self.refresh()

    def on_click(self, event: events.Click) -> None:
        place = event.get_content_offset(self)
        row = round(self.scroll_y) + (place.y if place is not None else len(self._drawn))
        if row < len(self._drawn):
            self.cursor = row
            self.refresh()
            self.post_message(self.Chosen(self._drawn[row][0]))

    def _lay_out(self) -> None:
        """Make screen lines of lines. Sections and bytes have one; other long ones go on."""
        width = max(self.scrollable_content_region.width, 10)
        drawn: list[tuple[Line, str]] = []
        for line in self._lines:
            if line.role in (Role.SECTION, Role.BYTES):
                drawn.append((line, line.value))
                continue
            label = min(cells(line.label), _LABEL_MAX)
            room = max(width - _indent(line) - (label + 1 if label else 0), 10)
            shown = wrap(line.value, room) if cells(line.value) > room else [line.value]
            if line.role not in _IN_FULL and len(shown) > _VALUE_LINES:
                shown[_VALUE_LINES - 1 :] = [fit(f"{shown[_VALUE_LINES - 1]} …", room)]
            drawn += [(line, text) for text in shown]
        self._drawn = drawn
        set_virtual_size(self, Size(width, len(drawn)))

    def _style(self, name: str) -> Style:
        return self.get_component_rich_style(f"inspector--{name}")

    def render_line(self, y: int) -> Strip:
        row = round(self.scroll_y) + y
        width = self.scrollable_content_region.width
        if row >= len(self._drawn):
            return Strip([Piece(" " * width, self._style("field"))], width)
        line, text = self._drawn[row]
        again = row > 0 and self._drawn[row - 1][0] is line
        sign = "  " if line.open is None or again else "▼ " if line.open else "▶ "
        label = "" if again else line.label
        if line.role is Role.SECTION:
            pieces = [
                Piece(sign if line.open is not None else "", self._style("label")),
                Piece(label, self._style("section")),
                Piece(f"  {text}" if text else "", self._style("field")),
            ]
        else:
            label = fit(label, _LABEL_MAX) if cells(label) > _LABEL_MAX else label
            gap = " " * (min(cells(line.label), _LABEL_MAX) if again else 0)
            pieces = [
                Piece(
                    "  " * line.depth + sign[2 if line.open is None else 0 :], self._style("label")
                ),
                Piece(f"{label or gap} " if label or gap else "", self._style("label")),
                Piece(text, self._style(line.role.value)),
            ]
        over = self._style("cursor") if self.has_focus and row == self.cursor else None
        return line_of(pieces, width, self._style("field"), more=self._style("label"), over=over)

    def _refresh_changes(self, before: list[tuple[Line, str]], cursor: int) -> None:
        """Draw what changed: over a slow line every row counts."""
        top = round(self.scroll_y)
        for y in range(self.scrollable_content_region.height):
            row = top + y
            old = before[row] if row < len(before) else None
            new = self._drawn[row] if row < len(self._drawn) else None
            if old != new or (row in (cursor, self.cursor) and self.has_focus):
                self.refresh(Region(0, y, self.size.width, 1))


def _indent(line: Line) -> int:
    return 2 * line.depth + (2 if line.open is not None else 0)
