"""What the screens of traces and of recordings have in common."""

from __future__ import annotations

from typing import Any

from textual.app import App

from rsltrace.trace.model.texts import printable
from rsltrace_viewer.terminal.widgets.prompt import Prompt


class BaseApp(App[None]):
    TITLE = "rsltrace view"

    def __init__(self, *, light: bool) -> None:
        super().__init__()
        self.busy = True
        """Whether something is about to be drawn that is not yet: for pictures and tests."""
        self.theme = "textual-light" if light else "textual-dark"

    def notify(self, message: str, **more: Any) -> None:
        """Show a message in a corner: what is in it may come from a file."""
        super().notify(printable(message), markup=False, **more)

    @property
    def prompt(self) -> Prompt:
        return self.screen_stack[0].query_one(Prompt)

    def has_worker(self, group: str) -> bool:
        return any(worker.group == group and worker.is_running for worker in self.workers)

    def action_theme(self) -> None:
        self.theme = "textual-dark" if self.theme == "textual-light" else "textual-light"

    async def action_quit(self) -> None:
        self.workers.cancel_all()
        self.exit()
