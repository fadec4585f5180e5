"""HTML for notebooks: small tables in which every text is plain text.

Names come from traces, and a trace may come from anybody: nothing is markup, and everything is
bounded.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import islice
from xml.etree.ElementTree import Element, SubElement, tostring

from rsltrace.trace.model.texts import printable, shortened

_ROWS_MAX = 20
_CELL_MAX = 120
_TITLE_MAX = 600
_LINES_MAX = 60
_LINE_MAX = 160
_LEFT = {"style": "text-align: left; vertical-align: top"}


class HtmlSheet:
    """A title with tables and texts, built from top to bottom."""

    def __init__(self, title: str) -> None:
        self._box = Element("div", {"class": "rsltrace"})
        self._paragraph("strong", title)

    def line(self, text: str) -> None:
        self._paragraph("span", text)

    def facts(self, rows: Iterable[tuple[str, object]]) -> None:
        self.table((), rows)

    def table(self, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """Add a table of at most ``_ROWS_MAX`` rows; nothing without rows."""
        left = iter(rows)
        shown = list(islice(left, _ROWS_MAX))
        more = sum(1 for _ in left)
        if not shown:
            return
        table = SubElement(self._box, "table")
        if header:
            self._row(SubElement(table, "thead"), "th", header)
        body = SubElement(table, "tbody")
        for row in shown:
            self._row(body, "td", row)
        if more:
            self.line(f"… {more} more")

    def text(self, text: str, *, summary: str) -> None:
        """Add a text of several lines, folded below ``summary``."""
        lines = text.splitlines()
        kept = [_cut(line, _LINE_MAX) for line in lines[:_LINES_MAX]]
        if len(lines) > len(kept):
            kept.append(f"… {len(lines) - len(kept)} more lines")
        folded = SubElement(self._box, "details")
        SubElement(folded, "summary").text = printable(summary)
        SubElement(folded, "pre").text = "\n".join(kept)

    def html(self) -> str:
        return tostring(self._box, encoding="unicode", method="html")

    def _paragraph(self, kind: str, text: str) -> None:
        paragraph = SubElement(self._box, "p", {"style": "margin: 0.3em 0"})
        SubElement(paragraph, kind).text = _cut(text, _TITLE_MAX)

    def _row(self, parent: Element, kind: str, cells: Sequence[object]) -> None:
        row = SubElement(parent, "tr")
        for cell in cells:
            SubElement(row, kind, _LEFT).text = _cut(str(cell), _CELL_MAX)


def _cut(text: str, width: int) -> str:
    return shortened(printable(text[: width + 1]), width)
