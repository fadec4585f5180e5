"""The report of two recordings as a person reads it."""

from __future__ import annotations

from rsltrace.diff.bags.model import (
    BagDiff,
    BagMessage,
    BagVerdict,
    LoneTopic,
    MessageDivergence,
    Presence,
    Recording,
    TopicDiff,
)
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report.line import (
    BAD,
    COMMAND,
    FAINT,
    GOOD,
    HEIGHT,
    NOTHING,
    SIDE_A,
    SIDE_B,
    TITLE,
    Line,
    Piece,
    Section,
    cut,
    fitted,
    in_columns,
    line,
    side_lines,
    wrapped,
)
from rsltrace.diff.report.words import field_lines, sentence_text
from rsltrace.model.printable import printable, shortened
from rsltrace.model.stamp import format_duration, format_seconds

_UP_TO_TIME = 5


def bag_report(
    diff: BagDiff, options: DiffOptions, width: int = 100, height: int = HEIGHT
) -> list[Line]:
    """Return the report of two recordings, at most ``height`` lines unless all is asked for."""
    style = BAD if diff.verdict is BagVerdict.DIFFERENT else GOOD
    head = wrapped(sentence_text(diff.sentence), width, style=style)
    sides = (("a", SIDE_A, diff.a), ("b", SIDE_B, diff.b))
    head += side_lines([_side_cells(*side) for side in sides], width, kept=_UP_TO_TIME)
    head.append(line(f"  verdict: {diff.verdict.value}; messages matched by {diff.by}"))
    sections = [_notes(diff, width)]
    if diff.first is not None:
        sections.append(_message(diff.first, width))
        sections.append(_before(diff.first, width))
    sections.append(_topics(diff, width))
    if options.everything:
        for topic in diff.topics:
            if topic.first is not None and topic.first is not diff.first:
                sections.append(_message(topic.first, width))
    if diff.next_step:
        row = line(("next: ", TITLE), (printable(diff.next_step), COMMAND))
        sections.append(Section((), [row], 1, ""))
    return fitted(head, sections, None if options.everything else height)


def _side_cells(name: str, style: str, side: Recording) -> list[Piece]:
    return [
        (name, style),
        (printable(side.path), ""),
        (printable(side.kind), ""),
        (f"{side.messages} messages", ""),
        (format_duration(side.end_ns - side.start_ns), ""),
        ("" if side.complete else "cut off", FAINT),
    ]


def _message(found: MessageDivergence, width: int) -> Section:
    title = f"{printable(found.topic)} ({printable(found.type)})"
    rows: list[Line] = []
    cells = []
    for name, style, message in (("a", SIDE_A, found.a), ("b", SIDE_B, found.b)):
        if message is None:
            cells.append([(name, style), ("nothing here", FAINT)])
        else:
            time = f"log time {format_seconds(message.stamp_ns)} s"
            cells.append([(name, style), (f"message {message.index}", ""), (time, "")])
    rows += in_columns(cells)
    rows += field_lines(found.fields, width)
    if found.more_fields:
        rows.append(line((f"    … {found.more_fields} more fields", FAINT)))
    if found.presence is not Presence.BOTH:
        only = found.a or found.b
        if only is not None and only.preview:
            rows.append(line(f"    {shortened(printable(only.preview), width - 4)}"))
    if found.reason:
        rows += wrapped(f"    {printable(found.reason)}", width, style=FAINT, indent="    ")
    return Section(line((title, TITLE)), rows, 14, "lines", least=6)


def _before(found: MessageDivergence, width: int) -> Section:
    if not found.before:
        return NOTHING
    side = "a" if found.a is not None else "b"
    rows = [cut(_brief(message), width) for message in found.before]
    title = line((f"before it on {printable(found.topic)}", TITLE), (f" (of {side})", FAINT))
    return Section(title, rows, 1, "messages", least=0, drop="first")


def _brief(message: BagMessage) -> Line:
    head = f"  {message.index}  {format_seconds(message.stamp_ns)}  "
    return line((head, FAINT), printable(message.preview))


def _topics(diff: BagDiff, width: int) -> Section:
    names = ("equal", "tolerated", "differ", "only a", "only b", "first at")
    header: list[Piece] = [("topic", FAINT), *((name, FAINT) for name in names)]
    parted = sorted(diff.topics, key=_first_place)
    cells = [header, *(_topic_cells(topic) for topic in parted)]
    for lone, at in ((diff.topics_only_a, 4), (diff.topics_only_b, 5)):
        cells += [_lone_cells(topic, at) for topic in lone]
    rows = [cut(row, width) for row in in_columns(cells)]
    return Section(rows[0], rows[1:], 4, "topics")


def _first_place(topic: TopicDiff) -> tuple[bool, int]:
    return (topic.first is None, topic.first.after_ns if topic.first else 0)


def _topic_cells(topic: TopicDiff) -> list[Piece]:
    counts = (topic.equal, topic.tolerated, topic.differing, topic.only_a, topic.only_b)
    when = f"{format_seconds(topic.first.after_ns)} s" if topic.first is not None else ""
    style = BAD if topic.parted else ""
    return [
        (printable(topic.topic), style),
        *((str(count), "" if count else FAINT) for count in counts),
        (when, ""),
    ]


def _lone_cells(topic: LoneTopic, at: int) -> list[Piece]:
    cells: list[Piece] = [(printable(topic.topic), BAD), *[("0", FAINT)] * 5, ("no such topic", "")]
    cells[at] = (str(topic.messages), "")
    cells[-1] = (f"only in {'a' if at == 4 else 'b'}", "")
    return cells


def _notes(diff: BagDiff, width: int) -> Section:
    rows = [row for note in diff.notes for row in wrapped(f"note: {printable(note)}", width)]
    return Section((), rows, min(len(rows), 3), "notes", min(len(rows), 2))
