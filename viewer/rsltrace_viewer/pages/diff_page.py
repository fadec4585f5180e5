"""The page of a comparison: what happened, where, and what to do next; below it the evidence.

The rows are those of the viewer: the same events in the same order, with the same words.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from markupsafe import Markup

from rsltrace.diff.facts.evidence import EventSummary, FieldDifference
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report import report_lines
from rsltrace.diff.report.differences import distance_text, message_title
from rsltrace.diff.report.divergence import event_text
from rsltrace.diff.report.line import plain_text
from rsltrace.diff.report.several import COLUMNS, how_all_agree, how_many_fail, several_cells
from rsltrace.diff.result import BagDiff, Diff, Divergence
from rsltrace.diff.row_sign import RowSign
from rsltrace.diff.sentences.divergence import no_event_text
from rsltrace.diff.sentences.values import setting_name
from rsltrace.errors import RsltraceError
from rsltrace.trace.model.operation import NODE_TOPICS
from rsltrace.trace.model.texts import contrasting_texts, format_seconds, printable, shortened
from rsltrace.trace.words.entities import SHORT_KINDS
from rsltrace.trace.words.phrases import as_sentence, path_word
from rsltrace_viewer.model.lanes import KIND_LETTERS
from rsltrace_viewer.model.plots.runs import RunPlots
from rsltrace_viewer.model.plots.series import PlotSource, difference, most_telling
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.source import CallbackCode, source_of
from rsltrace_viewer.model.timeline.events import EventText
from rsltrace_viewer.pages.charts import curves, svg_of
from rsltrace_viewer.pages.page import render_page
from rsltrace_viewer.session import Session

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


ROWS = 30
_BEFORE = 8
_VALUE_MAX = 80
_PLOTS_MAX = 6
_IN_FULL_MAX = 5
_VISIBLE = 0.02
"""Two curves that are closer than this part of their height look like one: a - b is drawn then."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the page shows of two traces beside the diff itself: rows, lanes, source and plots."""

    rows: Sequence[OrderRow] = ()
    lanes: Markup | None = None
    sources: Sequence[CallbackCode] = ()
    plots: Sequence[tuple[str, str, Markup]] = ()
    legend: str = ""


def diff_page(diffs: Sequence[Diff | BagDiff], options: DiffOptions) -> str:
    """Return the page of one or several runs against one; of several, the first few that differ in
    full. The traces are opened again. Raises TraceError."""
    failed = [diff for diff in diffs if diff.failed]
    heading = as_sentence(diffs[0].sentence)
    if len(diffs) > 1:
        golden = printable(diffs[0].a.path)
        several = how_many_fail(diffs, golden) if failed else how_all_agree(diffs, golden)
        heading = as_sentence(several)
    shown = diffs if len(diffs) == 1 else failed[:_IN_FULL_MAX]
    return render_page(
        "diff.html",
        heading=heading,
        good=not failed,
        several=[several_cells(diff) for diff in diffs] if len(diffs) > 1 else [],
        columns=COLUMNS,
        comparisons=[part_of(diff, options) for diff in shown],
    )


def part_of(diff: Diff | BagDiff, options: DiffOptions) -> dict[str, object]:
    """Return what the template needs of one comparison. Raises TraceError."""
    found = diff.shown if isinstance(diff, Diff) else None
    is_native = isinstance(diff, Diff) and diff.native is not None
    paths = f"{path_word(diff.a.path)} {path_word(diff.b.path)}"
    filters = filters_of(options)
    words = [" ".join(("rsltrace diff", paths, *map(shlex.quote, filters)))]
    words += [] if is_native else [f"rsltrace view {paths}"]
    following = found.next_step if found is not None else ""
    return {
        "diff": diff,
        "sentence": as_sentence(diff.sentence),
        "verdict": diff.verdict.value,
        "runs": _runs(diff),
        "found": found,
        "where": _where(found),
        "next": following,
        "commands": [one for one in words if one != following],
        "filters": " ".join(filters),
        "evidence": evidence_of(diff) if isinstance(diff, Diff) else Evidence(),
        "fields": [*_fields(diff)],
        "state": [(one.path, one.a, one.b) for one in found.state] if found is not None else [],
        "calls": found.calls if found is not None else [],
        "settings": [
            (setting_name(one), *contrasting_texts(one.a or "-", one.b or "-", _VALUE_MAX))
            for one in (diff.settings if isinstance(diff, Diff) else ())
        ],
        "report": "" if diff.identical else plain_text(report_lines(diff, options)),
    }


def filters_of(options: DiffOptions) -> list[str]:
    """Return what a diff leaves out or tolerates, as words of its command."""
    words = [f"--node={glob}" for glob in options.nodes]
    words += [f"--topic={glob}" for glob in options.topics]
    words += [f"--ignore={glob}" for glob in options.ignore]
    words += [f"--abs={glob}={value!r}" for glob, value in options.absolute]
    words += [f"--rel={glob}={value!r}" for glob, value in options.relative]
    return words


def _runs(diff: Diff | BagDiff) -> list[tuple[str, ...]]:
    if isinstance(diff, BagDiff):
        return [(s.path, f"{s.messages} messages", s.kind) for s in (diff.a, diff.b)]
    return [
        (s.path, f"{s.events} events", f"{format_seconds(s.end_ns)} s", s.digest, s.stop_reason)
        for s in (diff.a, diff.b)
    ]


def _where(found: Divergence | None) -> list[tuple[str, str]]:
    """Return where the runs diverge: the event of each, or the one of both."""
    if found is None:
        return []
    sides = [_event(one) if one else no_event_text(found.absence) for one in (found.a, found.b)]
    if sides[0] == sides[1]:
        return [("in both", sides[0])]
    return [*zip(("in a", "in b"), sides, strict=True)]


def _event(event: EventSummary) -> str:
    code = f" ({event.code})" if event.code else ""
    return f"{event_text(event)}, event {event.index} at {format_seconds(event.stamp_ns)} s{code}"


def _fields(diff: Diff | BagDiff) -> Iterator[tuple[str, list[tuple[str, str, str, str]], int]]:
    """Yield each message that differs, with its fields old and new, and how many more there are."""
    if isinstance(diff, BagDiff):
        if diff.first is not None:
            rows = [_field(one) for one in diff.first.fields]
            yield diff.first.topic, rows, diff.first.more_fields
        return
    for message in diff.shown.messages if diff.shown is not None else ():
        rows = [_field(one) for one in message.fields]
        if message.preview:
            rows.append(("", message.preview, "", ""))
        yield message_title(message), rows, message.more_fields


def _field(one: FieldDifference) -> tuple[str, str, str, str]:
    a, b = contrasting_texts(one.a, one.b, _VALUE_MAX)
    return one.path, a, b, distance_text(one)


def evidence_of(diff: Diff) -> Evidence:
    """Read what the page shows of two traces that diverge. Raises TraceError."""
    if diff.native is not None or diff.shown is None:
        return Evidence()
    with closing(Run.open(diff.a.path)) as a, closing(Run.open(diff.b.path)) as b:
        rows = [*order_rows(Session(a, b), diff)]
        sources, plots = [*_sources(a, b, diff)], [*_plots(a, b, diff)]
        return Evidence(rows, lanes_svg(rows), sources, plots, legend(rows))


def order_rows(session: Session, diff: Diff) -> Iterator[OrderRow]:
    """Yield the rows around the divergence that the diff shows. Raises TraceError."""
    comparison, found = session.comparison, diff.shown
    if comparison is None or found is None:
        return
    sides = [(one.index, other) for one, other in ((found.a, False), (found.b, True)) if one]

    def places() -> list[int]:
        return [comparison.place_of(index, other=other) for index, other in sides]

    while not comparison.runs.done and any(
        place < comparison.count and comparison.sign(place) is RowSign.UNKNOWN for place in places()
    ):
        session.take_block(comparison.runs.fetch())
    here = min(places(), default=comparison.first_place or 0)
    first = max(min(here - _BEFORE, comparison.count - ROWS), 0)
    shown = range(first, min(first + ROWS, comparison.count))
    for _ in session.read_values(shown):
        pass
    for place in shown:
        row = comparison.row(place)
        yield OrderRow(
            place,
            row.sign,
            session.row(place).event,
            None
            if row.elsewhere is None
            else comparison.place_of(row.elsewhere, other=row.b is None),
            place in places(),
        )


def _sources(a: Run, b: Run, diff: Diff) -> Iterator[CallbackCode]:
    """Yield the callback that diverged; of two different ones, both."""
    names = set()
    for run, event in zip((a, b), (diff.shown.a, diff.shown.b) if diff.shown else (), strict=False):
        with suppress(RsltraceError):  # the rows say what is damaged
            code = source_of(run, event.index) if event is not None else None
            if code is not None and code.name not in names:
                names.add(code.name)
                yield code


def _plots(a: Run, b: Run, diff: Diff) -> Iterator[tuple[str, str, Markup]]:
    """Yield plots of fields that differ: those of the divergence, then one of each topic that it
    reaches; each with how far the runs are from each other."""
    found = diff.shown
    if found is None:
        return
    some = found.a or found.b
    plots = RunPlots((a, b), "", topic="", stamp_ns=some.stamp_ns if some else None, diff=diff)
    known = [topic for topic in plots.topics() if topic not in NODE_TOPICS]
    chosen: list[PlotSource] = []
    named = [(one.topic, {field.path for field in one.fields}) for one in found.messages]
    for topic, paths in [*named, *((one.topic, set[str]()) for one in found.reaches)]:
        with suppress(RsltraceError):
            fields = plots.fields(topic) if topic in known else []
            differing = [f for f in fields if f.field in paths and "stamp" not in f.field]
            if not differing and fields and not any(one.name == topic for one in chosen):
                differing = [most_telling(fields, plots.messages(topic))]
            chosen += differing
    for source in list(dict.fromkeys(chosen))[:_PLOTS_MAX]:
        with suppress(RsltraceError):
            yield from _plot(plots, source)


def _plot(plots: RunPlots, source: PlotSource) -> Iterator[tuple[str, str, Markup]]:
    *_, series = plots.series(source)
    label, between = source.label, difference(series)
    if between is not None and np.ptp(between.values) < _VISIBLE * np.ptp(series[0].values):
        label, series = f"a − b of {label}", [between]
    drawn = curves(series, label, plots.cursor_s())
    if drawn is not None:
        yield label, between.note if between is not None else "", drawn
