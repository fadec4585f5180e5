"""A text over the other screens, such as an answer. Enter goes to the event that it is about."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.content import Content
from textual.screen import ModalScreen
from textual.widgets import Static

_WIDTH_MAX = 130


class TextScreen(ModalScreen[int | None]):
    """Gives the event if Enter was pressed, or None."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,q,v,r", "dismiss(None)", "close"),
        Binding("enter", "go", "go"),
    ]
    DEFAULT_CSS = """
    TextScreen { align: center middle; }
    TextScreen > VerticalScroll { width: 100%; max-width: 130; height: 100%; padding: 0 1;
                                  background: $surface; border: round $primary; }
    TextScreen.answer > VerticalScroll { height: auto; max-height: 100%; }
    """

    def __init__(self, title: str, text: Content | None = None, event: int | None = None) -> None:
        """Show a text under a title; ``event`` is that which it is about."""
        super().__init__(classes="" if text is None else "answer")
        self._title, self._text, self._event = title, text, event

    def compose(self) -> ComposeResult:
        with VerticalScroll() as box:
            box.border_title = Content(self._title)
            goes = "" if self._event is None else f"Enter goes to event {self._event}, "
            box.border_subtitle = f"{goes}Esc closes, ↓ scrolls"
            yield Static(self.text())

    def on_resize(self) -> None:
        self.query_one(Static).update(self.text())

    def text(self) -> Content:
        return self._text or Content()

    @property
    def room(self) -> int:
        return max(min(self.app.size.width, _WIDTH_MAX) - 6, 40)

    def action_go(self) -> None:
        self.dismiss(self._event)
