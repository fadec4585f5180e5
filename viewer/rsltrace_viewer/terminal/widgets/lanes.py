"""The overview: one lane per node, time from left to right, the selected event as a column."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from rich.segment import Segment as Piece
from rich.style import Style
from textual import events
from textual.binding import Binding, BindingType
from textual.geometry import Region
from textual.message import Message
from textual.strip import Strip
from textual.widget import Widget

from rsltrace.trace.model.texts import printable
from rsltrace_viewer.model.lanes import Lane, Lanes, axis_text
from rsltrace_viewer.model.timeline.columns import ShortNames
from rsltrace_viewer.model.view import cells, fit
from rsltrace_viewer.terminal.widgets.bars import node_style

_BLOCKS = " ▁▂▃▄▅▆▇█"
_LABEL_MAX = 28


class LanesView(Widget, can_focus=True):
    """Draws ``Lanes``. Left and right move by a column when it has the focus."""

    COMPONENT_CLASSES: ClassVar[set[str]] = {
        f"lanes--{name}"
        for name in (
            "axis",
            "focused",
            "label",
            "own",
            "bar",
            "cursor",
            "raised",
            "warning",
            "divergence",
            "empty",
        )
    }
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("left,h", "move(-1)", "a column back", show=False),
        Binding("right", "move(1)", "a column on", show=False),
    ]
    DEFAULT_CSS = """
    LanesView { background: $surface; height: 6; }
    LanesView > .lanes--axis { color: $text-muted; }
    LanesView > .lanes--focused { color: $text; text-style: bold; background: $primary; }
    LanesView > .lanes--label { color: $text-muted; }
    LanesView > .lanes--own { color: $text; text-style: bold; }
    LanesView > .lanes--bar { color: $text-primary; }
    LanesView > .lanes--cursor { color: $text-accent; background: $accent 30%; text-style: bold; }
    LanesView > .lanes--raised { color: $text-error; text-style: bold; }
    LanesView > .lanes--warning { color: $text-warning; text-style: bold; }
    LanesView > .lanes--divergence { color: $text-error; background: $error 30%; }
    LanesView > .lanes--empty { color: $text-muted; }
    """

    class Picked(Message):
        """A column was clicked: ``position`` is a time, or a place where each has its column."""

        def __init__(self, position: int, *, order: bool) -> None:
            super().__init__()
            self.position = position
            self.order = order

    class Zoomed(Message):
        """The wheel was turned: 1 in, -1 out."""

        def __init__(self, step: int) -> None:
            super().__init__()
            self.step = step

    class Resized(Message):
        """There is another number of columns."""

    def __init__(self, *, id: str) -> None:  # Textual's name for it
        super().__init__(id=id)
        self.lanes: Lanes | None = None
        self.cursor: int = 0
        self._position = 0
        self._own = ""
        self._divergence: int | None = None
        self._divergences: frozenset[int] = frozenset()
        self._two = False
        self._label_width = 8
        self._names = ShortNames(())
        self._colours: Mapping[str, int] = {}

    @property
    def columns(self) -> int:
        return max(self.size.width - self._before_lanes - 1, 1)

    @property
    def _before_lanes(self) -> int:
        return self._label_width + (4 if self._two else 2)

    def fit_labels(
        self, labels: list[str], width: int, colours: Mapping[str, int], *, two: bool = False
    ) -> None:
        """Make room for the names of the lanes (of ``two`` runs) in ``width`` cells, in the
        ``colours`` of their nodes."""
        self._two, self._colours = two, colours
        shown = [printable(label) for label in labels]
        longest = max(map(cells, shown), default=4)
        self._names = ShortNames(shown)
        self._label_width = max(4, min(longest, _LABEL_MAX, width // 6))

    def show(
        self,
        lanes: Lanes,
        position: int,
        *,
        own: str,
        divergence: int | None = None,
        divergences: frozenset[int] = frozenset(),
    ) -> None:
        """Show lanes with the cursor at a time (or place), in the lane named ``own``.

        ``divergence`` is the column where two runs diverge first, ``divergences`` are all.
        """
        before = (self.lanes, self.cursor, self._divergences, self._first_lane())
        axis, owner = self._position, self._own
        self.lanes = lanes
        self._position = position
        self._own = own
        self.cursor = lanes.window.column(position, lanes.columns)
        self._divergence, self._divergences = divergence, divergences
        now = (self.lanes, self.cursor, self._divergences, self._first_lane())
        width, last = self.size.width, self.size.height - 1
        if now[0] is before[0] and now[1:] == before[1:]:
            # Only the name of the lane one is in, and the time, can be different.
            if own != owner:
                for place, lane in enumerate(lanes.lanes):
                    if lane.label in (own, owner):
                        self.refresh(Region(0, place - now[3], width, 1))
            if axis != position:
                self.refresh(Region(0, last, width, 1))
        else:
            self.refresh()

    def on_resize(self, event: events.Resize) -> None:
        self.post_message(self.Resized())

    def on_mouse_down(self, event: events.MouseDown) -> None:
        """Go to the column under the mouse, and on with it until the button is let go."""
        if event.button == 1:
            self.capture_mouse()
            self._pick(event.x)

    def on_mouse_move(self, event: events.MouseMove) -> None:
        """Go along while the button is held."""
        if self.app.mouse_captured is self:
            self._pick(event.x)

    def on_mouse_up(self, event: events.MouseUp) -> None:
        """Stay here."""
        if self.app.mouse_captured is self:
            self.release_mouse()

    def on_mouse_scroll_up(self, event: events.MouseScrollUp) -> None:
        event.stop()
        self.post_message(self.Zoomed(1))

    def on_mouse_scroll_down(self, event: events.MouseScrollDown) -> None:
        event.stop()
        self.post_message(self.Zoomed(-1))

    def _pick(self, x: int) -> None:
        column = x - self._before_lanes
        if self.lanes is None or not 0 <= column < self.lanes.columns or column == self.cursor:
            return
        window = self.lanes.window
        position = window.at(column, self.lanes.columns)
        self.post_message(self.Picked(position, order=window.order))

    def action_move(self, step: int) -> None:
        """Go to the next (or previous) column with something in it."""
        lanes = self.lanes
        if lanes is None:
            return
        column = self.cursor + step
        while 0 <= column < lanes.columns:
            if any(_has(lane, column) for lane in lanes.lanes):
                position = lanes.window.at(column, lanes.columns)
                order = lanes.window.order
                self.post_message(self.Picked(position, order=order))
                return
            column += step

    def _style(self, name: str) -> Style:
        return self.get_component_rich_style(f"lanes--{name}")

    def _first_lane(self) -> int:
        """Which lane is on top: the selected one stays in sight when there are too many."""
        if self.lanes is None:
            return 0
        room = self.size.height - 1
        names = [lane.label for lane in self.lanes.lanes]
        if len(names) <= room or self._own not in names:
            return 0
        return max(0, min(names.index(self._own) - room // 2, len(names) - room))

    def render_line(self, y: int) -> Strip:
        width = self.size.width
        if self.lanes is None:
            return Strip([Piece(" " * width, self._style("empty"))], width)
        if y == self.size.height - 1:
            marks = self._divergences
            axis = axis_text(self.lanes, self._position, self.cursor, marks)
            text = fit(" " * self._before_lanes + axis, width)
            return Strip([Piece(text, self._style("focused" if self.has_focus else "axis"))], width)
        place = self._first_lane() + y
        if place >= len(self.lanes.lanes):
            return Strip([Piece(" " * width, self._style("empty"))], width)
        return self._lane(place, self.lanes, width)

    def _lane(self, place: int, lanes: Lanes, width: int) -> Strip:
        lane = lanes.lanes[place]
        own = lane.label == self._own
        again = place > self._first_lane() and lanes.lanes[place - 1].label == lane.label
        label = self._names.fit("" if again else printable(lane.label), self._label_width)
        lead = ">" if own and not again else " "
        run = f" {lane.run}" if self._two else ""
        colour = self._colours.get(lane.label)
        paint = Style() if colour is None else node_style(self, colour)
        name = self._style("own" if own else "label") + paint
        pieces = [Piece(f"{lead}{label}{run} ", name)]
        text = lane.letters or "".join(_BLOCKS[level] for level in lane.levels)
        bar = self._style("bar") + paint
        for column, character in enumerate(text):
            style = bar
            if column in lane.signs:
                character = lane.signs[column]
                style = self._style("raised" if character == "!" else "warning")
            if column == self._divergence:
                character = "┆" if character == " " else character
                style = style + self._style("divergence")
            if column == self.cursor:
                character = "│" if character == " " else character
                style = style + self._style("cursor")
            pieces.append(Piece(character, style))
        return Strip(pieces).simplify().adjust_cell_length(width, bar)


def _has(lane: Lane, column: int) -> bool:
    return lane.letters[column] != " " if lane.letters else lane.levels[column] > 0
