"""Events in order, as lanes of their nodes: a column for each row, run a above run b."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement

from markupsafe import Markup

from rsltrace.diff.row_sign import RowSign
from rsltrace.trace.model.texts import printable, shortened
from rsltrace.trace.words.kinds import SHORT_KINDS
from rsltrace_viewer.model.lanes import KIND_LETTERS
from rsltrace_viewer.model.timeline.events import EventText
from rsltrace_viewer.pages.charts import svg_of

_COLUMN, _LINE, _LABEL, _LEFT, _TOP = 22, 20, 16, 18, 16
_NODES_MAX = 12
_NAME_MAX = 60
_TIMES_EVERY = 5
_LETTERS = {SHORT_KINDS[kind]: (letter, kind.label) for kind, letter in KIND_LETTERS.items()}


@dataclass(frozen=True, slots=True)
class OrderRow:
    """A row of aligned runs: its place, how its events compare, and their words.

    ``moved_to`` is the place of the same event in the other run, ``here`` whether they diverge.
    """

    place: int
    sign: RowSign
    event: EventText
    moved_to: int | None
    here: bool

    @property
    def style(self) -> str:
        """The name of the sign in the style of the page."""
        return self.sign.name.lower().replace("_", "-")

    @property
    def title(self) -> str:
        """What a reader sees who points at it."""
        event = self.event
        sides = (f"{run} {index}" for run, index in zip("ab", event.numbers, strict=True) if index)
        what = f"{event.node} {event.kind} {event.entity}"
        return (
            f"{self.sign.value} {' / '.join(sides)}  {event.time} s  {shortened(what, _NAME_MAX)}"
        )


def legend(rows: Sequence[OrderRow]) -> str:
    """Return what the letters in the lanes mean."""
    kinds = {row.event.kind for row in rows}
    return ", ".join(" ".join(words) for kind, words in _LETTERS.items() if kind in kinds)


def lanes_svg(rows: Sequence[OrderRow]) -> Markup:
    """Draw the rows of two runs; events that moved are joined with themselves in the other run."""
    nodes = list(dict.fromkeys(row.event.node for row in rows))[:_NODES_MAX]
    width = _LEFT + _COLUMN * len(rows) + 4
    height = _TOP + len(nodes) * (_LABEL + 2 * _LINE + 6) + 16
    svg = Element("svg", {"width": f"{width}", "height": f"{height}", "role": "img"})
    SubElement(svg, "title").text = "The events of both runs in order, by node: a above b"
    across = {row.place: _LEFT + column * _COLUMN for column, row in enumerate(rows)}
    for row in rows:
        if row.here:
            place = {"x": f"{across[row.place]}", "y": "2", "width": f"{_COLUMN}"}
            SubElement(svg, "rect", {**place, "height": f"{height - 16}", "class": "here"})
    tops = {node: _TOP + n * (_LABEL + 2 * _LINE + 6) for n, node in enumerate(nodes)}
    for node, top in tops.items():
        _text(svg, _LEFT, top, shortened(node, _NAME_MAX))
        for name, line in (("a", 0), ("b", 1)):
            _text(svg, 4, top + _LABEL + line * _LINE + 3, name, name)
    for row in rows:
        if row.moved_to in across and row.event.numbers[1] and row.event.node in tops:
            x1, x2 = (across[at] + _COLUMN // 2 for at in (row.moved_to, row.place))
            y1 = tops[row.event.node] + 13
            ends = {"x1": f"{x1}", "y1": f"{y1}", "x2": f"{x2}", "y2": f"{y1 + _LINE}"}
            SubElement(svg, "line", {**ends, "class": "moved"})
    for row in rows:
        for line, index in enumerate(row.event.numbers):
            if index and row.event.node in tops:
                _cell(svg, across[row.place], tops[row.event.node] + 5 + line * _LINE, row)
    for row in rows[::_TIMES_EVERY]:
        _text(svg, across[row.place], height - 4, row.event.time.rstrip("0").rstrip("."), "faint")
    return svg_of(svg)


def _cell(svg: Element, x: int, y: int, row: OrderRow) -> None:
    group = SubElement(svg, "g", {"class": f"cell {row.style}"})
    SubElement(group, "title").text = printable(row.title)
    size = {"width": f"{_COLUMN - 3}", "height": f"{_LINE - 3}", "rx": "3"}
    SubElement(group, "rect", {"x": f"{x + 1}", "y": f"{y}", **size})
    _text(group, x + _COLUMN // 2, y + 12, _LETTERS.get(row.event.kind, "?")[0], "", "middle")


def _text(
    parent: Element, x: int, y: int, text: str, kind: str = "", anchor: str = "start"
) -> None:
    place = {"x": f"{x}", "y": f"{y}", "text-anchor": anchor, "class": kind}
    SubElement(parent, "text", place).text = printable(text)
