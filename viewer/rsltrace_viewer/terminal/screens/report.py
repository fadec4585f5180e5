"""The whole report on two runs, as `rsltrace diff` prints it."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.content import Content
from textual.screen import ModalScreen
from textual.widgets import Static

from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report import report_lines
from rsltrace.diff.report.line import Style
from rsltrace.diff.result import BagDiff, Diff, Divergence

_STYLES = {
    Style.TITLE: "bold $text-primary",
    Style.GOOD: "bold $text-success",
    Style.BAD: "bold $text-error",
    Style.SIDE_A: "$text-warning",
    Style.SIDE_B: "$text-success",
    Style.FAINT: "$text-muted",
    Style.COMMAND: "bold",
}


class ReportScreen(ModalScreen[None]):
    """Any of its keys closes it."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,q,v,enter", "dismiss", "close")]
    DEFAULT_CSS = """
    ReportScreen { align: center middle; }
    ReportScreen > VerticalScroll { width: 100%; max-width: 130; height: 100%; padding: 0 1;
                                    background: $surface; border: round $primary; }
    """

    def __init__(self, diff: Diff | BagDiff) -> None:
        super().__init__()
        self._diff = diff

    def compose(self) -> ComposeResult:
        """Make the text."""
        width = min(self.app.size.width, 130) - 6
        lines = report_lines(_without_view(self._diff), DiffOptions(), width=max(width, 40))
        text = Content("\n").join(
            Content.assemble(*((piece, _STYLES.get(style, "")) for piece, style in line))
            for line in lines
        )
        with VerticalScroll() as box:
            box.border_title = "why the runs diverge"
            box.border_subtitle = "Esc closes, ↓ scrolls"
            yield Static(text)


def _without_view(diff: Diff | BagDiff) -> Diff | BagDiff:
    """Return a diff that does not propose to open the viewer: one is there."""
    if isinstance(diff, BagDiff):
        return diff

    def without(one: Divergence) -> Divergence:
        return replace(one, next_step="") if one.next_opens_viewer else one

    return replace(
        diff,
        divergences=tuple(without(one) for one in diff.divergences),
        effect=None if diff.effect is None else without(diff.effect),
    )
