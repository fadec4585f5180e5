"""Plots: what to plot at the left, the plot at the right, both runs over each other."""

from __future__ import annotations

from typing import ClassVar

from rich.segment import Segment as Piece
from rich.style import Style
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.content import Content
from textual.screen import Screen
from textual.strip import Strip
from textual.widget import Widget
from textual.widgets import OptionList, Static
from textual.widgets.option_list import Option

from rsltrace.errors import RsltraceError
from rsltrace.trace.model.texts import printable
from rsltrace_viewer.model.plots.series import (
    Plot,
    PlotData,
    PlotSource,
    Series,
    difference,
    most_telling,
    plot,
)
from rsltrace_viewer.model.view import fit
from rsltrace_viewer.terminal.follow import walk
from rsltrace_viewer.terminal.widgets.list_view import Choices

_AXIS = 11


class PlotView(Widget):
    COMPONENT_CLASSES: ClassVar[set[str]] = {"plot--axis", "plot--a", "plot--b", "plot--both"}
    DEFAULT_CSS = """
    PlotView { width: 1fr; height: 1fr; background: $background; }
    PlotView > .plot--axis { color: $text-muted; }
    PlotView > .plot--a { color: $text-primary; }
    PlotView > .plot--b { color: $text-warning; }
    PlotView > .plot--both { color: $text; }
    """

    def __init__(self, *, id: str) -> None:  # Textual's name for it
        super().__init__(id=id)
        self._series: list[Series] = []
        self._title = ""
        self._cursor_s: float | None = None
        self._plot: tuple[tuple[int, int], Plot] | None = None

    def show(self, title: str, series: list[Series], cursor_s: float | None) -> None:
        self._title, self._series, self._cursor_s = title, series, cursor_s
        self._plot = None
        self.refresh()

    def _made(self) -> Plot:
        size = (max(self.size.width - _AXIS - 1, 1), max(self.size.height - 2, 1))
        if self._plot is None or self._plot[0] != size:
            self._plot = size, plot(self._series, *size, self._cursor_s)
        return self._plot[1]

    def render_line(self, y: int) -> Strip:
        """Return the title, a row of the plot, or the time axis."""
        width = self.size.width
        axis = self.get_component_rich_style("plot--axis")
        if y == 0 or not any(len(one.times) for one in self._series):
            text = self._title if y == 0 else ""
            return Strip([Piece(fit(text, width), axis + Style(bold=True))], width)
        made = self._made()
        last = self.size.height - 1
        if y == last:
            left, right = f"{made.start:.3f} s", f"{made.end:.3f} s"
            line = " " * _AXIS + left + right.rjust(max(width - _AXIS - len(left) - 1, 0))
            return Strip([Piece(fit(line, width), axis)], width)
        row = y - 1
        # Of two rows, the first is the top, not the middle.
        value = {(last - 2) // 2: (made.high + made.low) / 2, last - 2: made.low, 0: made.high}
        label = f"{value[row]:.5g}" if row in value else ""
        label = f"{value[row]:.3g}" if len(label) > _AXIS - 2 else label
        tick = "┤" if label else "│"
        pieces = [Piece(f"{fit(label, _AXIS - 2, right=True)} {tick}", axis)]
        styles = [axis, *(self.get_component_rich_style(f"plot--{n}") for n in ("a", "b", "both"))]
        for character, owner in zip(made.rows[row], made.owner[row], strict=True):
            pieces.append(Piece(character, styles[owner]))
        return Strip(pieces).simplify().adjust_cell_length(width, axis)


class PlotScreen(Screen[None]):
    """Topics lead to their fields; rates and latencies are at the top."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,backspace", "back", "back"),
        Binding("q,p", "dismiss", "close"),
    ]
    DEFAULT_CSS = """
    PlotScreen Static { background: $panel; padding: 0 1; height: 1; }
    PlotScreen Horizontal { height: 1fr; }
    PlotScreen OptionList { width: 36; height: 1fr; border: none; background: $surface; }
    PlotScreen OptionList:focus { border: none; }
    PlotScreen #plot { height: 2fr; }
    PlotScreen #difference { height: 1fr; border-top: solid $panel; }
    PlotScreen.narrow Horizontal { layout: vertical; }
    PlotScreen.narrow OptionList { width: 1fr; height: 7; }
    """

    def __init__(self, data: PlotData) -> None:
        super().__init__()
        self._data = data
        self._choices: list[PlotSource | str] = []
        self._topic = ""

    def compose(self) -> ComposeResult:
        yield Static(id="what")
        with Horizontal():
            yield Choices()
            with Vertical():
                yield PlotView(id="plot")
                yield PlotView(id="difference")
        yield Static("↑↓ choose   Enter shows the fields of a topic   Esc back   q closes")

    def on_mount(self) -> None:
        """Plot the field that differs first, or the topic of what is selected."""
        self.set_class(self.app.size.width < 100, "narrow")
        topic, field = self._data.first()
        if not topic or not field or not self._fields_level(topic, field):
            self._top_level(topic)

    def _top_level(self, topic: str = "") -> None:
        self._topic = ""
        topics = self._data.topics()
        first = topics.index(topic) if topic in topics else 0
        self._offer([*topics, *self._data.others()], first)
        self.query_one("#what", Static).update(Content(f"plots  {self._data.title()}"))

    def _fields_level(self, topic: str, field: str = "") -> bool:
        fields = self._fields(topic)
        if not fields:
            return False
        self._topic = topic
        names = [source.field for source in fields]
        field = field if field in names else self._most_telling(topic, fields).field
        place = names.index(field)
        self._offer(list(fields), place)
        self.query_one("#what", Static).update(Content(f"plots  {printable(topic)}"))
        return True

    def _fields(self, topic: str) -> list[PlotSource]:
        try:
            return self._data.fields(topic)
        except RsltraceError as error:
            self.query_one("#plot", PlotView).show(printable(str(error)), [], None)
            return []

    def _most_telling(self, topic: str, fields: list[PlotSource]) -> PlotSource:
        try:
            messages = self._data.messages(topic)
        except RsltraceError:  # the plot will say it
            messages = []
        return most_telling(fields, messages)

    def _offer(self, choices: list[PlotSource | str], highlighted: int = 0) -> None:
        self._choices = choices
        options = self.query_one(OptionList)
        options.clear_options()
        options.add_options([Option(Content(_words(choice))) for choice in choices])
        if choices:
            options.highlighted = highlighted
        options.focus()

    def on_option_list_option_highlighted(self, event: OptionList.OptionHighlighted) -> None:
        """Plot what is under the cursor; of a topic, a field that differs or varies."""
        choice = self._choices[event.option_index]
        if isinstance(choice, PlotSource):
            self._plot(choice)
        elif fields := self._fields(choice):
            self._plot(self._most_telling(choice, fields))
        else:
            self._show(f"{printable(choice)} has no numbers", [])

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        choice = self._choices[event.option_index]
        if isinstance(choice, str):
            self._fields_level(choice)

    def _plot(self, source: PlotSource) -> None:
        def arrive(series: list[Series] | None, finished: bool) -> None:
            if not self.is_attached:
                return
            series = series or []
            notes = [one.note for one in series if one.note]
            title = f"{source.label}  {source.unit}".rstrip() + f"  ({', '.join(notes[:1])})"
            if len(series) > 1:
                title += "  a solid, b dotted"
            self._show(printable(title), series)

        walk(self.app, "plot", self._data.series(source), arrive)

    def _show(self, title: str, series: list[Series]) -> None:
        cursor = self._data.cursor_s()
        self.query_one("#plot", PlotView).show(title, series, cursor)
        below = self.query_one("#difference", PlotView)
        between = difference(series)
        below.display = between is not None
        if between is not None:
            below.show(f"a − b  ({between.note})", [between], cursor)

    def action_back(self) -> None:
        """From the fields to the topics, from there out."""
        if self._topic:
            self._top_level(self._topic)
        else:
            self.dismiss()


def _words(choice: PlotSource | str) -> str:
    if isinstance(choice, str):
        return f"{printable(choice)}  ›"
    return printable(choice.field or choice.label)
