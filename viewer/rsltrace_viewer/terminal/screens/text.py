"""What lies over the other screens: a text, such as an answer, and a list to choose one of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical, VerticalScroll
from textual.content import Content
from textual.screen import ModalScreen
from textual.widgets import OptionList, Static
from textual.widgets.option_list import Option

from rsltrace_viewer.terminal.widgets.list_view import Choices

_WIDTH_MAX = 130


class TextScreen(ModalScreen[int | None]):
    """Gives the event that the text is about if Enter was pressed, or None."""

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


class PickScreen(ModalScreen[int | None]):
    """Gives the number of the choice (an effect, a breakpoint), or None."""

    BINDINGS: ClassVar[list[BindingType]] = [
        ("escape,q", "dismiss(None)", "close"),
    ]
    DEFAULT_CSS = """
    PickScreen { align: center middle; }
    PickScreen > Vertical { width: 90%; max-width: 110; height: auto; max-height: 80%;
                            background: $surface; border: round $primary; padding: 0 1; }
    PickScreen OptionList { border: none; background: $surface; height: auto; max-height: 100%; }
    PickScreen OptionList:focus { border: none; }
    """

    def __init__(self, title: str, choices: Sequence[str]) -> None:
        super().__init__()
        self._title = title
        self._choices = choices

    def compose(self) -> ComposeResult:
        with Vertical() as box:
            box.border_title = Content(self._title)
            box.border_subtitle = "Enter chooses, Esc closes"
            yield Choices(*(Option(Content(choice)) for choice in self._choices))

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        self.dismiss(event.option_index)
