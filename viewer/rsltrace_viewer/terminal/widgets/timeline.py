"""The list of events. Only the rows on screen are read and drawn, whatever the trace's length."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from rich.segment import Segment as Piece
from rich.style import Style
from textual import events
from textual.geometry import Region, Size
from textual.message import Message
from textual.scroll_view import ScrollView
from textual.strip import Strip

from rsltrace.diff.row_sign import RowSign
from rsltrace_viewer.model.timeline.columns import ColumnLayout, EventRow
from rsltrace_viewer.model.view import fit
from rsltrace_viewer.terminal.widgets.bars import line_of, node_style, set_virtual_size

_MARGIN = 3
"""Rows kept in sight above and below the cursor."""
_DRAWN_MAX = 1000
_NODE = "node-"
"""What a style begins with that is the colour of a node."""


_SIGN_STYLES = {
    RowSign.MATCH: "muted",
    RowSign.DIFFERS: "differs",
    RowSign.ONLY_A: "only-a",
    RowSign.ONLY_B: "only-b",
    RowSign.MOVED: "moved",
    RowSign.UNKNOWN: "muted",
}


class Timeline(ScrollView, can_focus=True, inherit_bindings=False):
    """Rows that somebody else provides (``source``), a header, and a cursor."""

    COMPONENT_CLASSES: ClassVar[set[str]] = {
        f"timeline--{name}"
        for name in (
            "header",
            "focused",
            "muted",
            "time",
            "plain",
            "cursor",
            "related",
            "mark",
            "lead",
            "error",
            "warning",
            "differs",
            "only-a",
            "only-b",
            "moved",
        )
    }
    DEFAULT_CSS = """
    Timeline { background: $background; scrollbar-size: 1 1; overflow-x: hidden;
               overflow-y: scroll; }
    Timeline > .timeline--header { color: $text-muted; text-style: bold; background: $surface; }
    Timeline > .timeline--focused { color: $text; text-style: bold; background: $primary; }
    Timeline > .timeline--muted { color: $text-muted; }
    Timeline > .timeline--time { color: $text; }
    Timeline > .timeline--plain { color: $text; }
    Timeline > .timeline--cursor { background: $primary 30%; text-style: bold; }
    Timeline > .timeline--related { background: $secondary 25%; }
    Timeline > .timeline--lead { color: $text; text-style: bold; }
    Timeline > .timeline--mark { color: $text-accent; text-style: bold; }
    Timeline > .timeline--error { color: $text-error; text-style: bold; }
    Timeline > .timeline--warning { color: $text-warning; }
    Timeline > .timeline--differs { color: $text-error; text-style: bold; }
    Timeline > .timeline--only-a { color: $text-warning; text-style: bold; }
    Timeline > .timeline--only-b { color: $text-success; text-style: bold; }
    Timeline > .timeline--moved { color: $text-secondary; }
    """

    class Picked(Message):
        def __init__(self, row: int) -> None:
            super().__init__()
            self.row = row

    class Scrolled(Message):
        """Other rows are in sight, by the mouse."""

    class Resized(Message):
        """There is another number of cells to lay columns out in."""

    def __init__(self, *, id: str) -> None:  # Textual's name for it
        super().__init__(id=id)
        self.cursor = 0
        self.empty = "no events"
        self._source: Callable[[int], EventRow] | None = None
        self._count = 0
        self._columns = ColumnLayout()
        self._drawn: dict[int, tuple[EventRow, bool]] = {}
        """What each row looked like when it was drawn last."""

    @property
    def page(self) -> int:
        return max(self.scrollable_content_region.height - 1, 1)

    @property
    def in_sight(self) -> range:
        top = round(self.scroll_y)
        return range(top, min(top + self.page + 1, self._count))

    @property
    def row_width(self) -> int:
        return self.scrollable_content_region.width

    def show(self, source: Callable[[int], EventRow], count: int, columns: ColumnLayout) -> None:
        """Show ``count`` rows from ``source``; the cursor keeps its row if there is one."""
        self._source = source
        self._columns = columns
        if count != self._count:
            self._count = count
            set_virtual_size(self, Size(max(self.row_width, 1), count + 1))
        self.cursor = max(min(self.cursor, count - 1), 0)
        self.refresh()

    def go(self, row: int, *, centre: bool = False) -> None:
        """Move the cursor to ``row`` and bring it into sight."""
        old, self.cursor = self.cursor, max(min(row, self._count - 1), 0)
        top = round(self.scroll_y)
        page = self.page
        margin = min(_MARGIN, (page - 1) // 2)
        wanted = top
        if centre or not top - page < self.cursor < top + 2 * page:
            wanted = self.cursor - page // 2
        elif self.cursor < top + margin:
            wanted = self.cursor - margin
        elif self.cursor >= top + page - margin:
            wanted = self.cursor - page + margin + 1
        wanted = max(min(wanted, self._count - page), 0)
        if wanted != top:
            self.scroll_to(y=wanted, animate=False, force=True, immediate=True)
            self.refresh()
        else:
            for row in {old, self.cursor}:
                self._refresh_row(row)

    def page_to(self, row: int, pages: int) -> None:
        """Move the cursor to ``row`` and the view by whole pages, so that nothing is skipped."""
        self.scroll_to(
            y=self.scroll_y + pages * self.page, animate=False, force=True, immediate=True
        )
        self.go(row)
        self.refresh()

    def redraw(self) -> None:
        """Draw the rows again whose look has changed."""
        top = round(self.scroll_y)
        for y in range(1, self.size.height):
            row = top + y - 1
            if row < self._count and self._drawn.get(row) != self._look(row):
                self._refresh_row(row)

    def _look(self, row: int) -> tuple[EventRow, bool] | None:
        return (self._source(row), row == self.cursor) if self._source is not None else None

    def on_resize(self, event: events.Resize) -> None:
        set_virtual_size(self, Size(max(self.row_width, 1), self._count + 1))
        self.post_message(self.Resized())

    def on_mouse_scroll_down(self) -> None:
        """Look further down, without going there."""
        self.call_after_refresh(self.post_message, self.Scrolled())

    def on_mouse_scroll_up(self) -> None:
        """Look further up."""
        self.call_after_refresh(self.post_message, self.Scrolled())

    def on_click(self, event: events.Click) -> None:
        row = round(self.scroll_y) + event.y - 1
        if event.y >= 1 and row < self._count:
            self.post_message(self.Picked(row))

    def _refresh_row(self, row: int) -> None:
        y = row - round(self.scroll_y) + 1
        if 0 < y < self.size.height:
            self.refresh(Region(0, y, self.size.width, 1))

    def _style(self, name: str) -> Style:
        if name.startswith(_NODE):
            return self._style("plain") + node_style(self, int(name.removeprefix(_NODE)))
        return self.get_component_rich_style(f"timeline--{name}")

    def render_line(self, y: int) -> Strip:
        """Return line ``y`` of the widget: the header, or a row."""
        width = self.size.width
        if y == 0:
            style = self._style("focused" if self.has_focus else "header")
            return Strip([Piece(fit(self._columns.header(), width), style)], width)
        row = round(self.scroll_y) + y - 1
        if self._source is None or not 0 <= row < self._count:
            text = f"  {self.empty}" if y == 2 and not self._count else ""
            return Strip([Piece(fit(text, width), self._style("muted"))], width)
        shown = self._source(row)
        if len(self._drawn) > _DRAWN_MAX:
            self._drawn.clear()
        self._drawn[row] = shown, row == self.cursor
        return self._row(row, shown, width)

    def _row(self, row: int, shown: EventRow, width: int) -> Strip:
        selected = row == self.cursor
        lead = ">" if selected else {"cause": "←", "effect": "→"}.get(shown.related, " ")
        pieces = [Piece(lead, self._style("lead"))]
        for column, text in self._columns.cells(shown):
            name = _style_of(column.style, shown)
            if name == "node":
                colour = self._columns.colours.get(shown.event.node)
                name = "muted" if colour is None else f"{_NODE}{colour}"
            pieces.append(Piece(text + " ", self._style(name)))
        name = "cursor" if selected else "related" if shown.related else ""
        over = self._style(name) if name else None
        return line_of(pieces, width, self._style("plain"), over=over)


def _style_of(style: str, row: EventRow) -> str:
    """Return the style of a cell from that of its column, and how the row compares."""
    sign, event = row.sign, row.event
    if style == "sign":
        return "muted" if sign is None else _SIGN_STYLES[sign]
    if sign in (RowSign.ONLY_A, RowSign.ONLY_B, RowSign.DIFFERS) and style not in ("time", "node"):
        return _SIGN_STYLES[sign] if style in ("hash", "outputs") else "plain"
    if style == "mark":
        return {"!": "error", "w": "warning"}.get(row.mark, "mark")
    if style == "outputs":
        return "error" if event.raised else "warning" if event.warns else "plain"
    return "muted" if style == "hash" else style
