"""The lines at the top and the bottom: what is open and how it compares; which keys there are."""

from __future__ import annotations

from collections.abc import Sequence

from rich.segment import Segment as Piece
from rich.style import Style
from textual import events
from textual.content import Content
from textual.geometry import Size
from textual.scroll_view import ScrollView
from textual.strip import Strip
from textual.widget import Widget
from textual.widgets import Static

from rsltrace.trace.model.texts import printable
from rsltrace.trace.words.entities import NODE_COLOURS
from rsltrace_viewer.model.view import cells, fit, wrap
from rsltrace_viewer.terminal.keys import footer_keys

# What widgets that draw their own lines need of Textual beyond its usual ways.


def line_of(
    pieces: Sequence[Piece],
    width: int,
    plain: Style,
    *,
    more: Style | None = None,
    over: Style | None = None,
) -> Strip:
    """Return a line of ``width`` cells that goes on in ``plain``, or is cut, with an ellipsis in
    style ``more``. Background and weight of ``over`` lie over it."""
    strip = Strip(pieces)
    if more is not None and strip.cell_length > width:
        strip = Strip([*strip.crop(0, width - 1), Piece("…", more)])
    strip = strip.adjust_cell_length(width, plain)
    if over is None:
        return strip
    style = Style(bgcolor=over.bgcolor, bold=over.bold)
    return Strip([Piece(text, (old or style) + style) for text, old, _ in strip], width)


def node_style(widget: Widget, colour: int) -> Style:
    """Return the colour of a node, that of ``NODE_COLOURS`` for the widget's theme."""
    dark, light = NODE_COLOURS[colour]
    return Style(color=dark if widget.app.current_theme.dark else light)


def set_virtual_size(view: ScrollView, size: Size) -> None:
    """Say how much there is to scroll through.

    Setting the attribute would lay out and draw the whole screen again, for every event one steps
    to; with a scrollbar that is always there, nothing else on the screen can change.
    """
    if view.virtual_size != size:
        view.set_reactive(Widget.virtual_size, size)
        view._scroll_update(size)


def verdict_lines(height: int) -> int:
    """Return how many lines a verdict may take on a screen of so many: where there is room, it is
    not cut."""
    return 4 if height >= 20 else 1 if height >= 10 else 0


class HeaderBar(Static):
    """What is open, in a line; with two traces how they compare, in one or two more."""

    DEFAULT_CSS = """
    HeaderBar { height: auto; background: $panel; color: $text; padding: 0 1; }
    """

    def show(
        self, title: str, facts: str, mode: str, verdict: str, *, bad: bool, lines: int, width: int
    ) -> None:
        """Show a title, facts about it, what is shown of it (``mode``), and the verdict on two
        runs in at most ``lines``, on a screen of ``width`` cells."""
        title, facts, mode, verdict = map(printable, (title, facts, mode, verdict))
        width = max(width - 2, 1)
        mode = fit(f" {mode}", min(cells(mode) + 1, width // 2))
        title = fit(title, min(width - cells(mode), cells(title)))
        rest = fit(f"  {facts}", width - cells(title) - cells(mode))
        parts: list[tuple[str, str] | str] = [(title, "bold"), (rest, "$text-muted")]
        parts.append((mode, "bold $text-primary"))
        if verdict and lines:
            style = "bold $text-error" if bad else "bold $text-success"
            wrapped = wrap(verdict, width)
            shown = wrapped[:lines]
            if len(wrapped) > lines:
                shown[-1] = fit(f"{shown[-1]} {wrapped[lines]}", width)
            parts += [("\n" + line, style) for line in shown]
        self.update(Content.assemble(*parts))


class FooterBar(Static):
    """The most needed keys, as many as fit. A click does what the key does."""

    DEFAULT_CSS = """
    FooterBar { height: 1; background: $panel; color: $text; padding: 0 1; }
    """

    def __init__(self, *, id: str) -> None:  # Textual's name for it
        super().__init__(id=id)
        self._places: list[tuple[int, str]] = []

    def show(self, *, two: bool, searching: str, status: str, live: bool = False) -> None:
        status = printable(status)
        width = self.size.width - 2
        room = width - (cells(status) + 2 if status else 0)
        parts: list[Content | tuple[str, str] | str] = []
        self._places = []
        used = 0
        for shown, words, action in footer_keys(two=two, searching=searching, live=live):
            length = cells(shown) + cells(words) + 3
            if used + length > room:
                continue
            used += length
            parts += [(shown, "bold $text-primary"), f" {words}  "]
            self._places.append((used, action))
        if status:
            parts += [" " * max(width - used - cells(status), 1), (status, "bold")]
        self.update(Content.assemble(*parts), layout=False)

    async def on_click(self, event: events.Click) -> None:
        for end, action in self._places:
            if event.x - 1 < end:
                await self.app.run_action(f"app.{action}")
                return
