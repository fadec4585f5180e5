"""A list to choose one of: the effects of an event, the breakpoints of a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import BindingType
from textual.containers import Vertical
from textual.content import Content
from textual.screen import ModalScreen
from textual.widgets import OptionList
from textual.widgets.option_list import Option

from rsltrace_viewer.terminal.widgets.list_view import Choices


class PickScreen(ModalScreen[int | None]):
    """Gives the number of the choice, or None."""

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
