"""One divergence of two traces as sections of a report."""

from __future__ import annotations

from difflib import SequenceMatcher
from itertools import zip_longest

from rsltrace.diff.facts.evidence import CauseStep, EventSummary, MessageDifference, Presence
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
from rsltrace.diff.sentences.values import link_text, no_fields_text
from rsltrace.trace.model.texts import format_duration, format_seconds, printable, shortened
from rsltrace.trace.words.kinds import flag_names
from rsltrace.trace.words.phrases import event_title, seconds_text

CONTEXT = 5
"""Events before a divergence that are shown by default."""
_DEPTH_MAX = 6
_SIDE_BY_SIDE = 100
"""Columns of a screen in which two lists of events stand side by side."""

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
        at_once = (a.index, a.stamp_ns) == (b.index, b.stamp_ns)
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
        rows += _events_of([("a", Style.SIDE_A, a), ("b", Style.SIDE_B, b)], width)
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


def _events_of(sides: list[tuple[str, str, EventSummary | None]], width: int) -> list[Line]:
    rows = []
    for name, style, event in sides:
        cells = event_cells(event) if event is not None else [("no such event", Style.FAINT)]
        rows.append([(name, style), *cells])
    return [cut(row, width) for row in in_columns(rows, widest=52)]


def _message(message: MessageDifference, width: int) -> list[Line]:
    rows = wrapped(f"  {message_title(message)}", width, indent="    ")
    rows += payload_lines(
        message.fields, message.more_fields, message.preview, no_fields_text(message), width
    )
    told = message.fields or message.preview
    unknown = message.no_fields is not None or message.presence is Presence.BOTH
    if not told and unknown:
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
            a, b = ("not called" if v is None else printable(v) for v in (call.a, call.b))
            if len(what) + len(a) + len(b) + 28 <= width:
                pair = ((a, Style.SIDE_A), ("  |  ", Style.FAINT), (b, Style.SIDE_B))
                rows.append(cut(line("  ", mark, f"{what}  ", *pair), width))
            else:
                rows.append(cut(line("  ", mark, what), width))
                for name, style, value in (("a", Style.SIDE_A, a), ("b", Style.SIDE_B, b)):
                    rows.append(cut(line("      ", (f"{name} ", style), value), width))
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
    """Return the last events before: of both runs, and of the node where that says more."""
    keep = options.context if options.context > CONTEXT else 2
    sections = [_listed("events before it", found.before_a, found.before_b, width, keep, least=1)]
    seen = {event.index for event in (*found.before_a, *found.before_b)}
    own = (*found.same_node_a, *found.same_node_b)
    some = found.a or found.b
    if some is not None and any(event.index not in seen for event in own):
        title = f"earlier events of {printable(some.entity.node) or 'the run'}"
        sections.append(_listed(title, found.same_node_a, found.same_node_b, width, keep, least=0))
    return sections


def _listed(
    title: str,
    a: tuple[EventSummary, ...],
    b: tuple[EventSummary, ...],
    width: int,
    keep: int,
    least: int,
) -> Section:
    if not a and not b:
        return NOTHING
    alike = list(map(event_key, a)) == list(map(event_key, b))
    if alike:
        rows = [cut(row, width) for row in in_columns([event_cells(e) for e in a], widest=52)]
        heading = line((f"{title} (the same in both)", Style.TITLE))
        return Section(heading, rows, keep, "events", least, drop="first", rank=7)
    if width < _SIDE_BY_SIDE:
        how, rows = "(= is the same in both)", _below_each_other(a, b, width)
    else:
        how, rows = "(a left, b right; = is the same in both)", _side_by_side(a, b, width)
    heading = line((f"{title} ", Style.TITLE), (how, Style.FAINT))
    return Section(heading, rows, keep, "events", least, drop="first", rank=7)


def _beside(
    a: tuple[EventSummary, ...], b: tuple[EventSummary, ...]
) -> list[tuple[EventSummary | None, EventSummary | None]]:
    """Return two lists of events as pairs, with the same events beside each other."""
    keys_a, keys_b = ([event_key(event) for event in side] for side in (a, b))
    found = SequenceMatcher(None, keys_a, keys_b, autojunk=False).get_opcodes()
    if len(found) > 1 and found[0][0] in ("delete", "insert"):
        found = found[1:]  # what the other list, which is as long, does not reach back to
    pairs: list[tuple[EventSummary | None, EventSummary | None]] = []
    for _, i, i_end, j, j_end in found:
        pairs += zip_longest(a[i:i_end], b[j:j_end])
    return pairs


def _side_by_side(
    a: tuple[EventSummary, ...], b: tuple[EventSummary, ...], width: int
) -> list[Line]:
    """Return two lists of events as two columns."""
    half = (width - 5) // 2
    rows = []
    for left, right in _beside(a, b):
        text = f"  {_brief(left, half):<{half}}"
        if left is not None and right is not None and event_key(left) == event_key(right):
            rows.append(line(text, f"= {right.index}"))
        else:
            other = (_brief(right, half), Style.SIDE_B)
            rows.append(line((text, Style.SIDE_A), ("| ", Style.FAINT), other))
    return rows


def _below_each_other(
    a: tuple[EventSummary, ...], b: tuple[EventSummary, ...], width: int
) -> list[Line]:
    """Return two lists of events as one, for a narrow screen: ``=`` what is in both."""
    rows: list[list[Piece]] = []
    for left, right in _beside(a, b):
        if left is not None and right is not None and event_key(left) == event_key(right):
            rows.append([("=", Style.FAINT), *event_cells(left)])
            continue
        for name, style, event in (("a", Style.SIDE_A, left), ("b", Style.SIDE_B, right)):
            if event is not None:
                rows.append([(name, style), *event_cells(event)])
    return [cut(row, width) for row in in_columns(rows, widest=52)]


def _brief(event: EventSummary | None, width: int) -> str:
    if event is None:
        return ""
    done = f" -> {printable(event.summary)}" if event.summary else ""
    return shortened(
        f"{event.index} {seconds_text(event.stamp_ns)} {event_text(event)}{done}", width
    )


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
    for shown in range(len(parts), 0, -1):
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


def event_key(event: EventSummary) -> tuple[object, ...]:
    """Return what is equal for events that are the same except for their place in the run."""
    return (
        event.entity,
        event.stamp_ns,
        event.kind,
        event.input_hash,
        event.output_hash,
        event.flags,
    )
