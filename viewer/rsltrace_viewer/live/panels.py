"""What a live screen has besides: the callback's source, and the breakpoints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.syntax import Syntax
from textual.app import ComposeResult
from textual.containers import VerticalScroll
from textual.content import Content
from textual.widgets import Static

from rsltrace.debug.positions import Breakpoint
from rsltrace.model.printable import printable
from rsltrace_viewer.live.execution import Source

_SHOWN_MAX = 4


class SourceView(VerticalScroll, can_focus=True):
    """The lines of the callback that the selected event called."""

    DEFAULT_CSS = """
    SourceView { background: $surface; scrollbar-size: 1 1; border-top: solid $panel;
                 border-title-color: $text-muted; }
    SourceView:focus { border-top: solid $accent; }
    SourceView Static { width: auto; }
    """

    def __init__(self, *, id: str) -> None:  # Textual's name for it
        super().__init__(id=id)
        self._shown: Source | None = None
        self._light = False

    def compose(self) -> ComposeResult:
        """Make the text."""
        yield Static(id="code")

    def show(self, source: Source | None, *, light: bool) -> None:
        """Show a callback; None: there is none in Python."""
        if (source, light) == (self._shown, self._light) and source is not None:
            return
        self._shown, self._light = source, light
        code = self.query_one("#code", Static)
        if source is None:
            self.border_title = "source"
            code.update(Content.styled("no Python function", "$text-muted italic"))
            return
        self.border_title = Content(printable(f"{Path(source.file).name}:{source.line}"))
        lines = [printable(line) for line in source.lines]
        code.update(
            Syntax(
                "\n".join(lines) or source.name,
                "python",
                theme="ansi_light" if light else "ansi_dark",
                line_numbers=True,
                start_line=source.line,
                highlight_lines=set() if source.at is None else {source.at},
                background_color="default",
            )
        )
        above = 0 if source.at is None else source.at - source.line - self.size.height // 2
        self.scroll_to(0, max(above, 0), animate=False)


class BreakpointsPanel(Static):
    """The breakpoints, and which of them has stopped the run."""

    DEFAULT_CSS = """
    BreakpointsPanel { height: auto; background: $surface; border-top: solid $panel; padding: 0 1;
                  border-title-color: $text-muted; }
    """

    def show(self, found: Sequence[Breakpoint], hit: int | None) -> None:
        """Show breakpoints; ``hit`` is the number of the one at which the run stands."""
        self.border_title = "breakpoints"
        if not found:
            self.update(Content.styled("none: B sets one, as in /odom: twist.x > 3", "$text-muted"))
            return
        first = max(len(found) - _SHOWN_MAX, 0)
        lines = []
        for one in found[first:]:
            sign = "▶" if one.number == hit else "●"
            style = "bold $text-error" if one.number == hit else ""
            lines.append(Content.styled(printable(f"{sign} {one.number}  {one.text}"), style))
        if first:
            lines[0] = Content.styled(f"… {first + 1} more", "$text-muted")
        self.update(Content("\n").join(lines))
