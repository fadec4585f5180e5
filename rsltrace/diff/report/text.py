"""The report as text, of any comparison."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report.line import HEIGHT, Line
from rsltrace.diff.result import Diff

if TYPE_CHECKING:
    from rsltrace.diff.result import BagDiff


def report_lines(
    diff: Diff | BagDiff | Sequence[Diff | BagDiff],
    options: DiffOptions,
    *,
    width: int = 100,
    height: int = HEIGHT,
) -> list[Line]:
    """Return the report for people as lines of styled pieces (see ``report.line``).

    ``width`` and ``height`` are those of the screen it is to fit.
    """
    if isinstance(diff, Diff):
        from rsltrace.diff.report.trace_text import trace_report

        return trace_report(diff, options, width, height)
    if not isinstance(diff, Sequence):
        from rsltrace.diff.report.bag_text import bag_report

        return bag_report(diff, options, width, height)
    if len(diff) == 1:
        return report_lines(diff[0], options, width=width, height=height)
    from rsltrace.diff.report.several import several_report

    return several_report(diff)
