"""The whole report on two runs, as `rsltrace diff` prints it."""

from __future__ import annotations

from dataclasses import replace

from textual.content import Content

from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report import report_lines
from rsltrace.diff.report.line import Style
from rsltrace.diff.result import BagDiff, Diff, Divergence
from rsltrace.diff.sentences.runs import ALL_HINT
from rsltrace_viewer.terminal.screens.text import TextScreen

_STYLES = {
    Style.TITLE: "bold $text-primary",
    Style.GOOD: "bold $text-success",
    Style.BAD: "bold $text-error",
    Style.SIDE_A: "$text-warning",
    Style.SIDE_B: "$text-success",
    Style.FAINT: "$text-muted",
    Style.COMMAND: "bold",
}

_HINT = f"rsltrace diff {ALL_HINT}"  # which is no key here
_LINES_MAX = 200
"""More than a command prints: the screen scrolls, and what is left out is nowhere else."""


class ReportScreen(TextScreen):
    def __init__(self, diff: Diff | BagDiff) -> None:
        super().__init__("why the runs diverge")
        self._diff = diff

    def text(self) -> Content:
        diff = _without_view(self._diff)
        lines = report_lines(diff, DiffOptions(), width=self.room, height=_LINES_MAX)
        return Content("\n").join(
            Content.assemble(
                *((piece.replace(ALL_HINT, _HINT), _STYLES.get(style, "")) for piece, style in line)
            )
            for line in lines
        )


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
