"""One divergence of two traces as sections of a report."""

from __future__ import annotations

from itertools import takewhile

from rsltrace.diff.facts.evidence import (
    CauseStep,
    EventRow,
    EventSummary,
    MessageDifference,
    Presence,
)
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report.differences import hashes_text, message_title, payload_lines
from rsltrace.diff.report.line import (
    NOTHING,
    Line,
    Piece,
    Section,
    Style,
    cut,
    in_columns,
    line,
    wrapped,
)
from rsltrace.diff.result import Divergence
from rsltrace.diff.row_sign import RowSign
from rsltrace.diff.sentences.divergence import no_answer, no_event_text
from rsltrace.diff.sentences.event_differences import event_differences_text
from rsltrace.diff.sentences.values import link_text, no_fields_text
from rsltrace.trace.model.texts import format_duration, format_seconds, printable
from rsltrace.trace.words.entities import flag_names
from rsltrace.trace.words.phrases import event_title

CONTEXT = 5
"""Events before a divergence that are shown by default."""
_DEPTH_MAX = 6

_REACHES_LINES = 2


def divergence_sections(found: Divergence, width: int, options: DiffOptions) -> list[Section]:
    """Return what a report says of one divergence: what, why, what was before, what it reaches."""
    return [
        _event(found, width),
        _state(found, width),
        _calls(found, width),
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
        whens = [(one.index, one.stamp_ns, one.stamp_ns.start_ns) for one in (a, b)]
        at_once = whens[0] == whens[1]
        if at_once:
            title = f"event {a.index}, {format_seconds(a.stamp_ns)} s: {title}"
        if min(a.position, b.position) >= 0:
            counted = f", call {a.position + 1}"
            counted += f" (b: {b.position + 1})" if a.position != b.position else ""
            title += counted if len(title) + len(counted) <= width else ""
        if not at_once or a.flags != b.flags or not found.messages:
            rows += _did([("a", Style.SIDE_A, a), ("b", Style.SIDE_B, b)], width)
        if code := printable(a.code or b.code):
            if len(title) + len(code) + 3 <= width:
                title += f" ({code})"
            else:
                rows.insert(0, line(("  code ", Style.FAINT), code))
    elif some is not None:
        title = "where they diverge" if a and b else "the event"
        rows += _events_of(found, width)
    else:
        title = ""
    for message in found.messages:
        rows += _message(message, width)
    return Section(
        cut(line((title, Style.TITLE)), width) if title else (), rows, 12, "lines", least=3
    )


def _did(sides: list[tuple[str, str, EventSummary]], width: int) -> list[Line]:
    """Return when an event was and what it did, for one that is in both runs."""
    rows = []
    for name, style, event in sides:
        index, time, _, done = event_cells(event)
        rows.append([(name, style), (f"event {index[0]}", ""), (f"{time[0]} s", ""), done])
    return [cut(row, width) for row in in_columns(rows)]


def _events_of(found: Divergence, width: int) -> list[Line]:
    sides = (("a", Style.SIDE_A, found.a), ("b", Style.SIDE_B, found.b))
    rows = in_columns(
        [[(n, style), *event_cells(one)] for n, style, one in sides if one], widest=52
    )
    rows = [cut(row, width) for row in rows]
    for place, (name, style, event) in enumerate(sides):
        if event is None:
            first, *more = wrapped(printable(no_event_text(found.absence)), width - 5)
            none = [line("  ", (name, style), "  ", *first), *(line("     ", *one) for one in more)]
            rows[place:place] = none
    return rows


def _message(message: MessageDifference, width: int) -> list[Line]:
    rows = wrapped(f"  {message_title(message)}", width, indent="    ")
    rows += payload_lines(
        message.fields, message.more_fields, message.preview, no_fields_text(message), width
    )
    shown = message.fields or message.preview
    unknown = message.no_fields is not None or message.presence is Presence.BOTH
    if not shown and unknown:
        rows.append(line((f"    hashes {hashes_text(message)}", Style.FAINT)))
    return rows


def _state(found: Divergence, width: int) -> Section:
    """Return which attributes of the node differ after the event."""
    if not found.state:
        return NOTHING
    rows = [
        cut(
            line(
                f"  {printable(one.path)}  ",
                (_value(one.a), Style.SIDE_A),
                ("  |  ", Style.FAINT),
                (_value(one.b), Style.SIDE_B),
            ),
            width,
        )
        for one in found.state
    ]
    title = line(("state of the node afterwards", Style.TITLE))
    return Section(title, rows, 6, "values", least=2, rank=3)


def _value(value: str | None) -> str:
    return "(not there)" if value is None else printable(value)


def _calls(found: Divergence, width: int) -> Section:
    """Return what the guard found: calls in the event, or before it in the node."""
    if not found.calls:
        return NOTHING
    rows = []
    here = {view.index for view in (found.a, found.b) if view is not None}
    place = found.calls[0].where.partition(" in ")[0]
    rank = 8 if place in found.root_sentence else 2  # said there, too
    for call in found.calls:
        events = [event for event in (call.event_a, call.event_b) if event is not None]
        earlier = "" if here.intersection(events) else f", event {events[0]}"
        mark = ("! ", Style.BAD) if call.a != call.b else ("= ", Style.FAINT)
        what = f"{call.source}: {printable(call.call)}{earlier}"
        if call.a == call.b:
            rows.append(cut(line("  ", mark, what), width))
        else:
            a, b = (no_answer(call) if v is None else printable(v) for v in (call.a, call.b))
            if len(what) + len(a) + len(b) + 28 <= width:
                pair = ((a, Style.SIDE_A), ("  |  ", Style.FAINT), (b, Style.SIDE_B))
                rows.append(cut(line("  ", mark, f"{what}  ", *pair), width))
            else:
                rows.append(cut(line("  ", mark, what), width))
                for name, style, value in (("a", Style.SIDE_A, a), ("b", Style.SIDE_B, b)):
                    rows.append(cut(line("      ", (f"{name} ", style), value), width))
        if call.where:
            rows.append(cut(line((f"      at {printable(call.where)}", Style.FAINT)), width))
    if len(rows) == 2:  # one call on one line, and its place
        differs = " that differs" * found.calls[0].differs
        rows[0] = cut(line((f"external call{differs}: ", Style.TITLE), *rows[0][1:]), width)
        return Section((), rows, 2, "", least=1, rank=rank)
    title = "external calls"
    return Section(line((title, Style.TITLE)), rows, 8, "lines", least=3, rank=rank)


def _cause(found: Divergence, width: int) -> Section:
    if not found.root_sentence and len(found.chain) < 2:
        return NOTHING
    title, *more = wrapped(f"cause: {printable(found.root_sentence)}", width, indent="  ")
    title = line(("cause:", Style.TITLE), title[0][0].removeprefix("cause:"))
    last = len(found.chain) - 1
    rows = [cut(_step(step, at, last=at == last), width) for at, step in enumerate(found.chain)]
    if last == 0:
        rows = []  # the divergence itself, which is shown already
    fixed = len(more)
    return Section(title, [*more, *rows], fixed + 4, "steps", fixed + 2, "middle", fixed=fixed)


def _step(step: CauseStep, depth: int, *, last: bool) -> Line:
    event = step.a or step.b
    assert event is not None
    side = "" if step.a and step.b else " (only a)" if step.a else " (only b)"
    branch = "  " * min(depth, _DEPTH_MAX) + ("└ " if depth else "")
    index = str(event.index)
    if step.a and step.b and step.a.index != step.b.index:
        index = f"{step.a.index}/{step.b.index}"
    relation = printable(link_text(step.link))
    end: Piece = ("  <- here" if last and depth else "", Style.BAD)
    return line(
        f"  {branch}",
        (f"{index} ", Style.FAINT),
        f"{event_text(event)}{side}",
        (f"  {relation}" if relation else "", Style.FAINT),
        end,
    )


def _before(found: Divergence, width: int, options: DiffOptions) -> list[Section]:
    """Return the rows up to the divergence: of both runs, and of the node where that says more."""
    keep = options.context if options.context > CONTEXT else 2
    rows = found.rows
    before = tuple(takewhile(lambda row: row.sign is RowSign.MATCH, rows))
    alike = all(row.elsewhere is None for row in rows) and not any(
        row.sign is RowSign.MATCH for row in rows[len(before) :]
    )
    if alike:  # then comes what is shown already
        sections = [_listed("events before it", before, width, keep, least=1)]
    else:
        sections = [_listed("events around it", rows, width, keep, least=1)]
    some = found.a or found.b
    if some is not None and any(row not in rows for row in found.node_rows):
        title = f"earlier events of {printable(some.entity.node) or 'the run'}"
        sections.append(_listed(title, found.node_rows, width, keep, least=0))
    return sections


def _listed(title: str, rows: tuple[EventRow, ...], width: int, keep: int, least: int) -> Section:
    if not rows:
        return NOTHING
    if all(row.sign is RowSign.MATCH for row in rows):
        how = "(the same in both)"
        cells = [event_cells(row.a) for row in rows if row.a is not None]
        heading = line((f"{title} {how}", Style.TITLE))
    else:
        how = "(of a and b: = the same, ≠ differs, ~ moved, - only in a, + only in b)"
        cells = [_row_cells(row) for row in rows]
        heading = cut(line((f"{title} ", Style.TITLE), (how, Style.FAINT)), width)
    shown = [cut(row, width) for row in in_columns(cells, widest=52)]
    return Section(heading, shown, keep, "events", least, drop="first", rank=7)


def _row_cells(row: EventRow) -> list[Piece]:
    """Return a row as cells of a table: sign, numbers in a and b, time, what ran, what it did or
    in what the runs differ."""
    event = row.a or row.b
    assert event is not None
    style = "" if row.a and row.b else Style.SIDE_A if row.a else Style.SIDE_B
    numbers = [str(one.index) if one is not None else "" for one in (row.a, row.b)]
    did = event_cells(event)[-1][0]
    what = []
    if row.elsewhere is not None:
        what.append(f"{'↓' if row.is_below else '↑'} {'b' if row.a else 'a'} {row.elsewhere}")
    elif row.a is None or row.b is None:
        what.append(f"only in {'a' if row.a else 'b'}")
    what.append(printable(event_differences_text(row.messages)) or did)
    return [
        (row.sign.value, Style.FAINT),
        *((number, Style.FAINT) for number in numbers),
        (format_seconds(event.stamp_ns), Style.FAINT),
        (event_text(event), style),
        (" ".join(filter(None, what)), style),
    ]


def moved_text(moved_ns: int) -> str:
    """Return how much later a message came in b: ``4 ms later in b``."""
    return f"{format_duration(abs(moved_ns))} {'later' if moved_ns > 0 else 'earlier'} in b"


def _reaches(found: Divergence, width: int) -> Section:
    if not found.reaches:
        return NOTHING
    parts = []
    for reach in found.reaches:
        when = f"after {format_duration(reach.after_ns)}" if reach.after_ns else "immediately"
        moved = f" ({moved_text(reach.moved_ns)})" if reach.moved_ns else ""
        parts.append(f"{printable(reach.topic)} {when}{moved}")
    # Trying all of thousands of topics takes seconds, and a part has more than four characters.
    most = min(len(parts), _REACHES_LINES * max(width // 4, 1))
    for shown in range(most, 0, -1):
        more = [f"and {len(parts) - shown} more"] if shown < len(parts) else []
        rows = wrapped(f"affects {', '.join(parts[:shown] + more)}", width, indent="  ")
        if len(rows) <= _REACHES_LINES:
            break
    return Section((), rows, len(rows), "", len(rows), rank=5)


# -- events as rows ------------------------------------------------------------------------------


def event_text(event: EventSummary) -> str:
    """Return ``/filter: subscription /scan``, or what else ran."""
    return event_title(event.kind, event.entity)


def event_cells(event: EventSummary) -> list[Piece]:
    """Return an event as cells of a table: index, time, what ran, what it did."""
    flags = (f"[{name}]" for name in flag_names(event.flags))
    done = ", ".join(filter(None, [printable(event.summary), *flags]))
    return [
        (str(event.index), Style.FAINT),
        (format_seconds(event.stamp_ns), Style.FAINT),
        (event_text(event), ""),
        (f"-> {done}" if done else "", ""),
    ]
