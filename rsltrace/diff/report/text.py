"""The report of two traces as a person reads it: verdict first, on one screen."""

from __future__ import annotations

from rsltrace.diff.model import CauseStep, Diff, Divergence, EventView, MessageDifference, Side
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report.line import (
    BAD,
    BLANK,
    COMMAND,
    FAINT,
    GOOD,
    NOTHING,
    SIDE_A,
    SIDE_B,
    TITLE,
    Line,
    Piece,
    Section,
    fitted,
    in_columns,
    line,
    wrapped,
)
from rsltrace.diff.report.words import (
    cut,
    event_cells,
    event_text,
    field_lines,
    hashes_text,
    message_title,
    same_event,
)
from rsltrace.model.printable import printable, shortened
from rsltrace.model.stamp import format_duration, format_seconds

HEIGHT = 40
"""Lines of a report unless more is asked for: what fits a screen."""
_CONTEXT = 5
_DEPTH_MAX = 10


def trace_report(diff: Diff, options: DiffOptions, width: int = 100) -> list[Line]:
    """Return the report of two traces, at most ``HEIGHT`` lines unless ``options.everything``."""
    head = _head(diff, width)
    if not diff.divergences:
        sections = [_settings(diff, width), _notes(diff, width)]
        return fitted(head, sections, None)
    first, *others = diff.divergences
    sections = _divergence(first, width, options)
    sections.append(_afterwards(diff, width))
    sections.append(_settings(diff, width))
    sections.append(_notes(diff, width))
    if not options.everything:
        sections.append(_next(first, len(others), width))
        # Whoever asks for a longer context wants to see it.
        return fitted(head, sections, HEIGHT + 2 * max(options.context - _CONTEXT, 0))
    sections.append(_next(first, 0, width))
    lines = fitted(head, sections, None)
    for number, other in enumerate(others, start=2):
        lines += [BLANK, line((f"independent divergence {number}: {other.verdict.value}", TITLE))]
        lines += wrapped(printable(other.sentence), width, style=BAD)
        lines += fitted([], [*_divergence(other, width, options), _next(other, 0, width)], None)
    return lines


def within_tolerance(diff: Diff) -> bool:
    """Whether tolerances cover every difference of values that is known of every divergence.

    The digests differ all the same.
    """
    messages = [message for found in diff.divergences for message in found.messages]
    return bool(messages) and all(
        message.presence == "both"
        and message.fields
        # What no tolerance covers comes first, so what is not listed is covered if these are.
        and all(one.within_tolerance for one in message.fields)
        for message in messages
    )


def _head(diff: Diff, width: int) -> list[Line]:
    style = GOOD if diff.identical else BAD
    lines = wrapped(printable(diff.sentence), width, style=style)
    sides = [("a", SIDE_A, diff.a), ("b", SIDE_B, diff.b)]
    lines += in_columns([_side_cells(*side) for side in sides], widest=60)
    if not diff.identical:
        word = "event agrees" if diff.agreeing == 1 else "events agree"
        lines.append(line(f"  verdict: {diff.verdict.value}; {diff.agreeing} {word} before"))
        if within_tolerance(diff):
            lines.append(
                line(("  equal within tolerance, not identical: the digests differ", TITLE))
            )
    return lines


def _side_cells(name: str, style: str, side: Side) -> list[Piece]:
    ended = side.stop_reason or ("" if side.complete else "interrupted")
    time = f"{format_seconds(side.end_ns)} s"
    return [
        (name, style),
        (printable(side.path), ""),
        (f"{side.events} events", ""),
        (time, ""),
        (f"digest {side.digest}", ""),
        (printable(ended), FAINT),
    ]


def _divergence(found: Divergence, width: int, options: DiffOptions) -> list[Section]:
    return [
        _event(found, width),
        _cause(found, width),
        *_before(found, width, options),
        _reaches(found, width),
    ]


def _event(found: Divergence, width: int) -> Section:
    a, b = found.a, found.b
    rows: list[Line] = []
    some = a or b
    assert some is not None or not found.messages
    if a is not None and b is not None and a.entity == b.entity and a.kind is b.kind:
        title = event_text(a)
        if min(a.position, b.position) >= 0:
            title += f", its event {a.position + 1}"
            title += f" (b: {b.position + 1})" if a.position != b.position else ""
        if (a.index, a.stamp_ns) == (b.index, b.stamp_ns):
            title = f"event {a.index}, {format_seconds(a.stamp_ns)} s: {title}"
        else:
            rows += in_columns(
                [
                    [
                        ("a", SIDE_A),
                        (f"event {a.index}", ""),
                        (f"{format_seconds(a.stamp_ns)} s", ""),
                    ],
                    [
                        ("b", SIDE_B),
                        (f"event {b.index}", ""),
                        (f"{format_seconds(b.stamp_ns)} s", ""),
                    ],
                ]
            )
    elif some is not None:
        title = "what happened instead" if a and b else "the event"
        rows += _events_of([("a", SIDE_A, a), ("b", SIDE_B, b)], width)
    else:
        title = ""
    for message in found.messages:
        rows += _message(message, width)
    return Section(line((title, TITLE)) if title else (), rows, 12, "lines of differences", least=5)


def _events_of(sides: list[tuple[str, str, EventView | None]], width: int) -> list[Line]:
    rows = []
    for name, style, event in sides:
        cells = event_cells(event) if event is not None else [("nothing here", FAINT)]
        rows.append([(name, style), *cells])
    return [cut(row, width) for row in in_columns(rows, widest=44)]


def _message(message: MessageDifference, width: int) -> list[Line]:
    rows = [line(f"  {message_title(message)}")]
    if message.fields:
        rows += field_lines(message.fields, width)
        if message.more_fields:
            rows.append(line((f"    … {message.more_fields} more fields", FAINT)))
        return rows
    if message.preview:
        rows.append(line(f"    {shortened(printable(message.preview), width - 4)}"))
    if message.reason:
        rows += wrapped(f"    {printable(message.reason)}", width, style=FAINT, indent="    ")
    if not message.preview:
        rows.append(line((f"    hashes {hashes_text(message)}", FAINT)))
    return rows


def _cause(found: Divergence, width: int) -> Section:
    if not found.root_sentence and len(found.chain) < 2:
        return NOTHING
    rows = [
        cut(_step(step, depth, last=depth == len(found.chain) - 1), width)
        for depth, step in enumerate(found.chain)
    ]
    title: Line = line(("cause: ", TITLE), shortened(printable(found.root_sentence), width - 7))
    return Section(title, rows, 5, "steps", least=2, drop="middle")


def _step(step: CauseStep, depth: int, *, last: bool) -> Line:
    event = step.a or step.b
    assert event is not None
    side = "" if step.a and step.b else " (only a)" if step.a else " (only b)"
    branch = "  " * min(depth, _DEPTH_MAX) + ("└ " if depth else "")
    index = str(event.index)
    if step.a and step.b and step.a.index != step.b.index:
        index = f"{step.a.index}/{step.b.index}"
    relation = printable(step.relation)
    end: Piece = ("  <- here they part" if last and depth else "", BAD)
    return line(
        f"  {branch}",
        (f"{index} ", FAINT),
        f"{event_text(event)}{side}",
        (f"  {relation}" if relation else "", FAINT),
        end,
    )


def _before(found: Divergence, width: int, options: DiffOptions) -> list[Section]:
    """Return the last events before: of both runs, and of the node where that says more."""
    keep = options.context if options.context > _CONTEXT else 2
    sections = [_listed("before it", found.before_a, found.before_b, width, keep, least=1)]
    seen = {event.index for event in (*found.before_a, *found.before_b)}
    own = (*found.same_node_a, *found.same_node_b)
    some = found.a or found.b
    if some is not None and any(event.index not in seen for event in own):
        title = f"before it in {printable(some.entity.node) or 'the run'}"
        sections.append(_listed(title, found.same_node_a, found.same_node_b, width, keep, least=0))
    return sections


def _listed(
    title: str,
    a: tuple[EventView, ...],
    b: tuple[EventView, ...],
    width: int,
    keep: int,
    least: int,
) -> Section:
    if not a and not b:
        return NOTHING
    alike = len(a) == len(b) and all(map(same_event, a, b))
    if alike:
        rows = [cut(row, width) for row in in_columns([event_cells(e) for e in a], widest=44)]
        heading = line((f"{title} (the same in both)", TITLE))
        return Section(heading, rows, keep, "events", least, drop="first")
    half = (width - 5) // 2
    longest = max(len(a), len(b))
    left = [None] * (longest - len(a)) + list(a)
    right = [None] * (longest - len(b)) + list(b)
    rows = []
    for one, other in zip(left, right, strict=True):
        mark = " " if one and other and same_event(one, other) else "|"
        first = f"{_brief(one, half):<{half}}"
        rows.append(line("  ", first, (mark, BAD), f" {_brief(other, half)}".rstrip()))
    heading = line((f"{title} ", TITLE), ("(a left, b right)", FAINT))
    return Section(heading, rows, keep, "events", least, drop="first")


def _brief(event: EventView | None, width: int) -> str:
    if event is None:
        return ""
    done = f" -> {printable(event.summary)}" if event.summary else ""
    text = f"{event.index} {format_seconds(event.stamp_ns)} {event_text(event)}{done}"
    return shortened(text, width)


def _reaches(found: Divergence, width: int) -> Section:
    if not found.reaches:
        return NOTHING
    parts = []
    for reach in found.reaches:
        when = f"after {format_duration(reach.after_ns)}" if reach.after_ns else "at once"
        parts.append(f"{printable(reach.topic)} {when}")
    rows = wrapped(f"reaches {', '.join(parts)}", width, indent="  ")
    rows = (
        rows[:2] if len(rows) <= 2 else [*rows[:1], line("  ", (f"… {len(parts)} topics", FAINT))]
    )
    return Section((), rows, 2, "topics", 2)


def _afterwards(diff: Diff, width: int) -> Section:
    if not diff.counts:
        return NOTHING
    total = [
        sum(getattr(count, name) for count in diff.counts)
        for name in ("matching", "differing", "only_a", "only_b")
    ]
    text = (
        f"from there to event {diff.aligned_to[0]} of a and {diff.aligned_to[1]} of b: "
        f"{total[0]} events match, {total[1]} differ, {total[2]} only in a, {total[3]} only in b"
    )
    if diff.resync_index is not None:
        a, b = diff.resync_index
        text += f"; they agree again from event {a} of a, {b} of b on"
    rows = wrapped(text, width, indent="  ")
    least = len(rows)
    worst = sorted(diff.counts, key=lambda c: c.differing + c.only_a + c.only_b, reverse=True)
    for count in worst:
        parted = count.differing + count.only_a + count.only_b
        if parted:
            of = parted + count.matching
            rows.append(cut(line(f"  {parted} of {of}  {printable(str(count.entity))}"), width))
    return Section((), rows, least, "entities", least)


def _settings(diff: Diff, width: int) -> Section:
    if not diff.settings:
        return NOTHING
    room = max((width - 40) // 2, 16)
    rows = in_columns(
        [
            [
                (printable(setting.place), ""),
                (_value(setting.a, room), SIDE_A),
                ("|", FAINT),
                (_value(setting.b, room), SIDE_B),
            ]
            for setting in diff.settings
        ],
        widest=max(room, 34),
    )
    return Section(line(("job and environment differ", TITLE)), rows, 2, "settings")


def _value(text: str | None, room: int) -> str:
    return "-" if text is None else shortened(printable(text.strip()), room)


def _notes(diff: Diff, width: int) -> Section:
    rows = [row for note in diff.notes for row in wrapped(f"note: {printable(note)}", width)]
    return Section((), rows, min(len(rows), 2), "notes", min(len(rows), 2))


def _next(found: Divergence, others: int, width: int) -> Section:
    rows = []
    if others:
        word = "divergence" if others == 1 else "divergences"
        rows.append(line(f"{others} more independent {word}: --all shows them"))
    if found.next_step:
        rows.append(line(("next: ", TITLE), (printable(found.next_step), COMMAND)))
    return Section((), rows, len(rows), "", len(rows))
