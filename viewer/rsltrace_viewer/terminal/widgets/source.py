"""The source of a callback, with the numbers of its lines."""

from __future__ import annotations

from pathlib import Path

from textual.app import ComposeResult
from textual.containers import VerticalScroll
from textual.content import Content
from textual.highlight import highlight
from textual.widgets import Static

from rsltrace.trace.model.texts import printable
from rsltrace_viewer.model.source import CallbackCode


class SourceView(VerticalScroll, can_focus=True):
    """The lines of the callback that the selected event called."""

    DEFAULT_CSS = """
    SourceView { background: $surface; scrollbar-size: 1 1; border-top: solid $panel;
                 border-title-color: $text-muted; border-subtitle-color: $text-warning; }
    SourceView:focus { border-top: heavy $primary; }
    SourceView #code { width: 100%; text-wrap: nowrap; text-overflow: ellipsis; }
    SourceView #note { width: 100%; color: $text-warning; }
    """

    def __init__(self, *, id: str) -> None:  # Textual's name for it
        super().__init__(id=id)
        self._shown: CallbackCode | None = None

    def compose(self) -> ComposeResult:
        yield Static(id="note")
        yield Static(id="code")

    def show(self, source: CallbackCode | None) -> None:
        """Show a callback, with signs at lines that wait or send; None: there is none in Python."""
        if source == self._shown and source is not None:
            return
        self._shown = source
        code, note = self.query_one("#code", Static), self.query_one("#note", Static)
        note.display = bool(source is not None and source.note)
        if source is None:
            self.border_title = "source"
            code.update(Content.styled("no Python function is known", "$text-muted italic"))
            return
        self.border_title = Content(printable(f"{Path(source.file).name}:{source.line}"))
        note.update(Content(printable(source.note)))
        text = "\n".join(printable(line) for line in source.lines)
        rows = highlight(text or printable(source.name), language="python").split(
            "\n", allow_blank=True
        )
        width = len(str(source.line + len(rows))) if source.lines else 0
        code.update(
            Content("\n").join(
                _numbered(number, row, width, _sign(source, number))
                for number, row in enumerate(rows, source.line)
            )
        )
        shown = source.at or min((n for n in source.sent if n >= source.line), default=source.line)
        above = shown - source.line - self.size.height // 2
        self.scroll_to(0, max(above, 0), animate=False)


def _sign(source: CallbackCode, number: int) -> tuple[str, str]:
    """Return what stands before a line, and its style: where it waits, where it sent something."""
    if number == source.at:
        return "▶", "bold $text-accent"
    return ("→", "$text-success") if number in source.sent else (" ", "$text-muted")


def _numbered(number: int, row: Content, width: int, sign: tuple[str, str]) -> Content:
    return Content.styled(f"{sign[0]}{number:>{width}} ", sign[1]) + row if width else row
