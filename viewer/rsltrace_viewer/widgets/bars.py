"""The lines at the top and the bottom: what is open and how it compares; which keys there are."""

from __future__ import annotations

from textual.content import Content
from textual.widgets import Static

from rsltrace_viewer.keys import footer_keys
from rsltrace_viewer.model.cells import cells


class HeaderBar(Static):
    """What is open, in one line or two."""

    DEFAULT_CSS = """
    HeaderBar { height: auto; max-height: 3; background: $panel; color: $text; padding: 0 1; }
    """

    def show(self, title: str, facts: str, verdict: str = "", *, bad: bool = False) -> None:
        """Show a title, facts about it, and the verdict on two runs on a line of its own."""
        text = Content.assemble((title, "bold"), "  ", (facts, "$text-muted"))
        if verdict:
            style = "bold $text-error" if bad else "bold $text-success"
            text = Content.assemble(text, "\n", (verdict, style))
        self.update(text, layout=bool(verdict))


class FooterBar(Static):
    """The most needed keys, as many as fit. A click does what the key does."""

    DEFAULT_CSS = """
    FooterBar { height: 1; background: $panel; color: $text; padding: 0 1; }
    """

    def show(self, *, two: bool, searching: str, status: str) -> None:
        """Show the keys, and a status at the right."""
        room = self.size.width - 2 - (cells(status) + 2 if status else 0)
        parts: list[Content] = []
        for shown, words, action in footer_keys(two=two, searching=searching):
            length = cells(shown) + cells(words) + 3
            if length > room:
                continue
            room -= length
            key = Content.styled(shown, "bold $text-accent")
            item = Content.assemble(key, " ", words, "  ")
            parts.append(item.stylize(f"@click=app.{action}") if "'" not in action else item)
        text = Content.assemble(*parts)
        if status:
            fill = max(self.size.width - 2 - text.cell_length - cells(status), 1)
            text = Content.assemble(text, " " * fill, (status, "$text-warning"))
        self.update(text, layout=False)
