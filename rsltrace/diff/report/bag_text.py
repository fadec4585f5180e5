"""The report of two recordings, or native runs, as a person reads it."""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.diff.facts.bags import (
    BagComparison,
    BagMessage,
    ComparedRecording,
    LoneTopic,
    MessageDivergence,
    NativeComparison,
    TopicDiff,
)
from rsltrace.diff.facts.evidence import Presence
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report.differences import payload_lines
from rsltrace.diff.report.line import (
    HEIGHT,
    NOTHING,
    Line,
    Piece,
    Section,
    Style,
    cut,
    fitted,
    head_lines,
    in_columns,
    line,
    next_section,
    notes_section,
    wrapped,
)
from rsltrace.diff.result import BagDiff
from rsltrace.diff.sentences.runs import order_text, tail_text
from rsltrace.diff.sentences.values import no_fields_text
from rsltrace.trace.model.texts import (
    format_duration,
    format_milliseconds,
    format_seconds,
    printable,
)

_COLUMNS = (
    ("equal", "equal"),
    ("tolerated", "tolerated"),
    ("ignored", "ignored"),
    ("differ", "differing"),
    ("moved", "moved"),
    ("only a", "only_a"),
    ("only b", "only_b"),
)
_RARE = ("ignored", "moved")
"""Shown only where some topic has any."""


def bag_report(
    diff: BagDiff, options: DiffOptions, width: int = 100, height: int = HEIGHT
) -> list[Line]:
    """Return the report of two recordings: ``height`` lines at most, or ``options.everything``."""
    good = not diff.failed
    verdict = f"{diff.verdict.value}; messages matched by {diff.by}"
    sides = [_facts(side) for side in (diff.a, diff.b)]
    head = head_lines(diff.sentence, sides, verdict, width, good=good)
    sections = [notes_section(diff.notes, width)]
    if diff.first is not None:
        sections.append(divergence_section(diff.first, width))
        sections.append(_before(diff.first, width))
    sections.append(topics_section(diff, width))
    if options.everything:
        for topic in diff.topics:
            if topic.first is not None and topic.first is not diff.first:
                sections.append(divergence_section(topic.first, width))
    sections.append(next_section(diff.next_step, width=width))
    return fitted(head, sections, None if options.everything else height)


def _facts(side: ComparedRecording) -> list[Piece]:
    return [
        (printable(side.path), ""),
        (printable(side.kind), ""),
        (f"{side.messages} messages", ""),
        (format_duration(side.end_ns - side.start_ns), ""),
        ("" if side.complete else "truncated", Style.FAINT),
    ]


def divergence_section(found: MessageDivergence, width: int) -> Section:
    """Return what differs in a message."""
    title = f"{printable(found.topic)} ({printable(found.type)})"
    rows: list[Line] = []
    cells = []
    for name, style, message in (("a", Style.SIDE_A, found.a), ("b", Style.SIDE_B, found.b)):
        if message is None:
            cells.append([(name, style), ("no such message", Style.FAINT)])
        else:
            time = f"log time {format_seconds(message.stamp_ns)} s"
            cells.append([(name, style), (f"message {message.index}", ""), (time, "")])
    rows += in_columns(cells)
    only = None if found.presence is Presence.BOTH else found.a or found.b
    if moved := order_text(found):
        only = found.a
        rows.append(line(f"    {printable(moved)}"))
    preview = only.preview if only is not None else ""
    rows += payload_lines(found.fields, found.more_fields, preview, no_fields_text(found), width)
    return Section(line((title, Style.TITLE)), rows, 14, "lines", least=6)


def _before(found: MessageDivergence, width: int) -> Section:
    if not found.before:
        return NOTHING
    side = "a" if found.a is not None else "b"
    rows = [cut(_brief(message), width) for message in found.before]
    title = line(
        (f"before it on {printable(found.topic)}", Style.TITLE), (f" (of {side})", Style.FAINT)
    )
    return Section(title, rows, 1, "messages", least=0, drop="first")


def _brief(message: BagMessage) -> Line:
    head = f"  {message.index}  {format_seconds(message.stamp_ns)}  "
    return line((head, Style.FAINT), printable(message.preview))


def topics_section(diff: BagComparison, width: int) -> Section:
    """Return a table of the topics: how many messages of each are equal, and so on."""
    columns = [
        (name, attribute)
        for name, attribute in _COLUMNS
        if attribute not in _RARE or any(getattr(topic, attribute) for topic in diff.topics)
    ]
    names = ("topic", *(name for name, _ in columns), "first at")
    header: list[Piece] = [(name, Style.FAINT) for name in names]
    attributes = [attribute for _, attribute in columns]
    shared = sorted(diff.topics, key=_first_place)
    cells = [header, *(_topic_cells(topic, attributes) for topic in shared)]
    for lone, side in ((diff.topics_only_a, "a"), (diff.topics_only_b, "b")):
        cells += [_lone_cells(topic, attributes, side) for topic in lone]
    rows = [cut(row, width) for row in in_columns(cells)]
    return Section(rows[0], rows[1:], 4, "topics")


def _first_place(topic: TopicDiff) -> tuple[bool, int]:
    return (topic.first is None, topic.first.after_ns if topic.first else 0)


def _topic_cells(topic: TopicDiff, attributes: Sequence[str]) -> list[Piece]:
    counts = [getattr(topic, attribute) for attribute in attributes]
    when = f"{format_seconds(topic.first.after_ns)} s" if topic.first is not None else ""
    style = Style.BAD if topic.diverged else ""
    return [
        (printable(topic.topic), style),
        *((str(count), "" if count else Style.FAINT) for count in counts),
        (when, ""),
    ]


def _lone_cells(topic: LoneTopic, attributes: Sequence[str], side: str) -> list[Piece]:
    counts = [topic.messages if name == f"only_{side}" else 0 for name in attributes]
    return [
        (printable(topic.topic), Style.BAD),
        *((str(count), "" if count else Style.FAINT) for count in counts),
        (f"only in {side}", ""),
    ]


# -- native runs ---------------------------------------------------------------------------------


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
    if (first := found.first_moved) is not None:
        which = f"{first.entity}, event {first.event_a} of a and {first.event_b} of b"
        text = f"order: the first of {found.moved} callbacks that moved is {which}"
        rows += wrapped(printable(text), width, indent="  ")
    for tail in found.tails:
        rows += wrapped(f"end: {printable(tail_text(tail))}", width, indent="  ")
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
                    (format_milliseconds(None if times is None else getattr(times, name)), style)
                    for name in ("median_ns", "p95_ns")
                    for times, style in ((one.a, Style.SIDE_A), (one.b, Style.SIDE_B))
                ),
            ]
        )
    rows = [cut(row, width) for row in in_columns(cells)]
    title = line(("timing", Style.TITLE), " in ms: periods of timers, latencies after the cause")
    return Section(title, rows, 6, "callbacks", fixed=1)
