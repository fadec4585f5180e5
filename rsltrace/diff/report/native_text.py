"""What the report of two runs says where one is native: messages by topic, order and times."""

from __future__ import annotations

from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report.bag_text import divergence_section, topics_section
from rsltrace.diff.report.frame import next_section
from rsltrace.diff.report.line import Line, Piece, Section, Style, cut, in_columns, line, wrapped
from rsltrace.diff.result.native import NativeComparison
from rsltrace.model.printable import printable


def native_sections(found: NativeComparison, options: DiffOptions, width: int) -> list[Section]:
    """Return the sections of a report, what matters most first."""
    content = found.content
    sections = []
    if found.first is not None:
        sections.append(divergence_section(found.first, width))
    sections.append(topics_section(content, width))
    sections.append(_order(found, width))
    sections.append(_times(found, width))
    if options.everything:
        sections += [
            divergence_section(topic.first, width)
            for topic in content.topics
            if topic.first is not None and topic.first is not found.first
        ]
    if found.differs:
        sections.append(next_section(content.next_step, width=width))
    return sections


def _order(found: NativeComparison, width: int) -> Section:
    rows: list[Line] = []
    if found.first_moved:
        text = f"order: the first of {found.moved} callbacks that moved is {found.first_moved}"
        rows += wrapped(printable(text), width, indent="  ")
    for tail in found.tails:
        rows += wrapped(f"end: {printable(tail)}", width, indent="  ")
    return Section((), rows, 4, "lines")


def _times(found: NativeComparison, width: int) -> Section:
    names = ("callback", "", "runs a", "runs b", "median a", "median b", "95 % a", "95 % b")
    cells: list[list[Piece]] = [[(name, Style.FAINT) for name in names]]
    for one in found.callbacks:
        cells.append(
            [
                (printable(str(one.entity)), ""),
                (one.measure, Style.FAINT),
                (str(one.events_a), Style.SIDE_A),
                (str(one.events_b), Style.SIDE_B),
                *(
                    (_ms(None if times is None else getattr(times, name)), style)
                    for name in ("median_ns", "p95_ns")
                    for times, style in ((one.a, Style.SIDE_A), (one.b, Style.SIDE_B))
                ),
            ]
        )
    rows = [cut(row, width) for row in in_columns(cells)]
    title = line(("timing", Style.TITLE), " in ms: periods of timers, latencies after the cause")
    return Section(title, rows, 6, "callbacks", fixed=1)


def _ms(duration_ns: int | None) -> str:
    return "-" if duration_ns is None else f"{duration_ns / 1e6:.4g}"
