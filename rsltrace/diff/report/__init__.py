"""Reports of diffs: for a terminal, a program, a pull request and continuous integration.

A report reads a ``Diff`` or ``BagDiff`` and nothing else; no file is opened again.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report.line import plain_text
from rsltrace.diff.report.text import report_lines
from rsltrace.diff.result import BagDiff, Diff
from rsltrace.errors import TraceError

FORMATS = ("text", "json", "markdown", "junit", "github")

__all__ = ["FORMATS", "render", "report_lines"]


def render(
    diff: Diff | BagDiff | Sequence[Diff | BagDiff],
    format: str = "text",
    options: DiffOptions | None = None,
    *,
    width: int = 100,
) -> str:
    """Return a diff, or several of one golden run, in one of ``FORMATS``, ending in a newline.

    ``width`` is that of text lines. Raises TraceError for another format.
    """
    options = options or DiffOptions()
    several = list(diff) if isinstance(diff, Sequence) else [diff]
    if not several:
        raise TraceError("there is nothing to report: no run was compared")
    if format == "text":
        return plain_text(report_lines(diff, options, width=width))
    if format == "json":
        from rsltrace.diff.report.as_json import as_json, several_as_json

        one = len(several) == 1
        content = as_json(several[0]) if one else several_as_json(several)
        return json.dumps(content, indent=2, allow_nan=False) + "\n"
    if format == "markdown":
        from rsltrace.diff.report.markdown import markdown, several_markdown

        one = len(several) == 1
        return markdown(several[0], options) if one else several_markdown(several, options)
    if format in ("junit", "github"):
        from rsltrace.diff.report.ci import github, junit

        return (junit if format == "junit" else github)(several, options)
    raise TraceError(f"there is no report format {format!r}; there are {', '.join(FORMATS)}")
