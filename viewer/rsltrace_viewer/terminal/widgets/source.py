"""The source of a callback, with the numbers of its lines."""

from __future__ import annotations

from pathlib import Path

from rich.syntax import Syntax
from textual.app import ComposeResult
from textual.containers import VerticalScroll
from textual.content import Content
from textual.widgets import Static

from rsltrace.model.printable import printable
from rsltrace_viewer.model.source import Source


class SourceView(VerticalScroll, can_focus=True):
    """The lines of the callback that the selected event called."""

    DEFAULT_CSS = """
    SourceView { background: $surface; scrollbar-size: 1 1; border-top: solid $panel;
                 border-title-color: $text-muted; border-subtitle-color: $text-warning; }
    SourceView:focus { border-top: solid $accent; }
    SourceView Static { width: auto; }
    SourceView #note { color: $text-warning; }
    """

    def __init__(self, *, id: str) -> None:  # Textual's name for it
        super().__init__(id=id)
        self._shown: Source | None = None
        self._light = False

    def compose(self) -> ComposeResult:
        """Make the text."""
        yield Static(id="note")
        yield Static(id="code")

    def show(self, source: Source | None, *, light: bool) -> None:
        """Show a callback; None: there is none in Python."""
        if (source, light) == (self._shown, self._light) and source is not None:
            return
        self._shown, self._light = source, light
        code, note = self.query_one("#code", Static), self.query_one("#note", Static)
        note.display = bool(source is not None and source.note)
        if source is None:
            self.border_title = "source"
            code.update(Content.styled("no Python function is known", "$text-muted italic"))
            return
        self.border_title = Content(printable(f"{Path(source.file).name}:{source.line}"))
        note.update(Content(printable(source.note)))
        lines = [printable(line) for line in source.lines]
        code.update(
            Syntax(
                "\n".join(lines) or printable(source.name),
                "python",
                theme="ansi_light" if light else "ansi_dark",
                line_numbers=bool(lines),
                start_line=source.line,
                highlight_lines=set() if source.at is None else {source.at},
                background_color="default",
            )
        )
        above = 0 if source.at is None else source.at - source.line - self.size.height // 2
        self.scroll_to(0, max(above, 0), animate=False)
