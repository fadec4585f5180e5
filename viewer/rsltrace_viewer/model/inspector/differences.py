"""A pair of events of two runs as lines: what differs, field by field, and where it came from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rsltrace.diff.alignment.aligned_rows import AlignedRow
from rsltrace.diff.alignment.rows import ComparedTrace as DiffRun
from rsltrace.diff.causes.state_differences import state_differences
from rsltrace.diff.facts.evidence import (
    CallDifference,
    EventSummary,
    FieldDifference,
    MessageDifference,
    Presence,
    StateDifference,
)
from rsltrace.diff.facts.remarks import EndedByException
from rsltrace.diff.report.differences import distance_text
from rsltrace.diff.result import Divergence
from rsltrace.diff.row_sign import RowSign
from rsltrace.diff.sentences.divergence import no_answer, no_event_text
from rsltrace.diff.sentences.runs import remark_text
from rsltrace.diff.sentences.values import link_text, no_fields_text
from rsltrace.errors import TraceError
from rsltrace.trace.model.texts import Stamp, format_duration, format_seconds, printable, shortened
from rsltrace.trace.words.entities import RUN_NAME, SHORT_KINDS
from rsltrace_viewer.model.comparison import Comparison
from rsltrace_viewer.model.inspector.effects import Effects
from rsltrace_viewer.model.inspector.event import event_link, inspect
from rsltrace_viewer.model.inspector.message_tree import Line, Openness, Role

# What differs between two runs beside messages, as lines: states of nodes, calls from outside.

_VALUE_MAX = 200


def differing_state_lines(
    runs: tuple[DiffRun, DiffRun],
    views: tuple[EventSummary | None, EventSummary | None],
    divergence: Divergence | None,
    openness: Openness,
) -> Iterator[Line]:
    """Yield the attributes in which a node's states differ after an event of both runs.

    At the divergence they are known and shown; elsewhere they are looked for when opened.
    """
    a, b = views
    if (
        a is None
        or b is None
        or not (a.state_hash and b.state_hash)
        or a.state_hash == b.state_hash
    ):
        return
    is_open = openness.is_open("states", divergence is not None)
    yield Line(0, "≠ state", f"of {a.entity.node} after it", Role.SECTION, "states", is_open)
    if not is_open:
        return
    found: Sequence[StateDifference]
    found = divergence.state if divergence is not None else state_differences(*runs, a, b)
    for place, one in enumerate(found):
        path = f"states.{place}"
        yield Line(1, "", printable(one.path), Role.DIFFERENCE, path)
        for name, value in (("a", one.a), ("b", one.b)):
            text = "not there" if value is None else shortened(printable(value), _VALUE_MAX)
            yield Line(2, name, text, Role.FIELD, f"{path}.{name}")
    if not found:
        hint = "only hashes were recorded; guard: {state: record} in the job keeps the values"
        yield Line(1, "", hint, Role.NOTE, "states.none")


def differing_call_lines(calls: Sequence[CallDifference]) -> Iterator[Line]:
    """Yield the calls from outside that gave different answers, in the event or before it."""
    for place, call in enumerate(call for call in calls if call.a != call.b):
        path = f"calls.{place}"
        yield Line(0, "≠ call", f"{call.source}: {printable(call.call)}", Role.SECTION, path)
        yield Line(1, "at", printable(call.where), Role.NOTE, f"{path}.at")
        for name, value, event in (("a", call.a, call.event_a), ("b", call.b, call.event_b)):
            text = no_answer(call) if value is None else shortened(printable(value), _VALUE_MAX)
            link = event if value is not None else None
            yield Line(
                1, name, text, Role.FIELD, f"{path}.{name}", link=link, other_run=name == "b"
            )


_SAYS = {
    RowSign.MATCH: "the same in both runs",
    RowSign.DIFFERS: "differs",
    RowSign.ONLY_A: "in run a only",
    RowSign.ONLY_B: "in run b only",
    RowSign.MOVED: "the same, at another time or place in the order",
    RowSign.UNKNOWN: "not compared (beyond what was matched)",
}
_FIRST_SHOWN = 3


def pair_lines(
    comparison: Comparison, place: int, openness: Openness, effects: Effects | None = None
) -> list[Line]:
    """Return the lines of the inspector for a place of two runs. ``effects`` are those of the
    event in run a, or in run b if it is there only."""
    row = comparison.row(place)
    (a, b), sign = row.pair, row.sign
    lines = list(_title(comparison, place, row))
    try:
        first = place == comparison.first_place
        if first:  # the reason comes first: in a small terminal little else fits
            lines += _why(comparison)
        if sign not in (RowSign.MATCH, RowSign.UNKNOWN):
            lines += _difference_lines(comparison, a, b, openness, first=first)
        if first and comparison.diff is not None and comparison.diff.shown is not None:
            lines += chain_lines(comparison, comparison.diff.shown)
        if sign not in (RowSign.MATCH, RowSign.UNKNOWN):
            lines += _cause_lines(comparison, a, b)
    except TraceError as error:
        lines.append(Line(0, "", printable(str(error)), Role.ERROR, "diff.error"))
    for run, index, name in ((comparison.run_a, a, "a"), (comparison.run_b, b, "b")):
        if index is None or (name == "b" and a is not None and sign is RowSign.MATCH):
            continue
        words = f"run {name}" if sign is not RowSign.MATCH else "both runs"
        # Where they agree there is nothing better to show than the event itself.
        is_open = openness.is_open(f"run{name}", sign is RowSign.MATCH)
        lines.append(Line(0, words, f"event {index}", Role.SECTION, f"run{name}", is_open))
        if is_open:
            said = {"event", "event.at"} if sign is RowSign.MATCH else {"event"}
            own = name == "a" or a is None
            if not own:
                said.add("effects")  # nobody looks for these; run a's are shown
            inner = (
                line
                for line in inspect(run, index, openness, effects if own else None)
                if line.path not in said
            )
            lines += [_of_run(line, other=name == "b") for line in inner]
    return lines


def _of_run(line: Line, *, other: bool) -> Line:
    return Line(
        line.depth, line.label, line.value, line.role, line.path, line.open, line.link, other
    )


def _title(comparison: Comparison, place: int, row: AlignedRow) -> Iterator[Line]:
    (a, b), sign = row.pair, row.sign
    view = (
        comparison.runs.view(b or 0, of_b=True)
        if a is None
        else comparison.runs.view(a, of_b=False)
    )
    entity = f"{view.entity.node or RUN_NAME}  {view.kind.label} {view.entity.name}"
    number = str(a if a is not None else b)
    if a is not None and b is not None and a != b:
        number = f"{a} / {b}"
    yield Line(0, f"event {number}", printable(entity), Role.SECTION, "event")
    role = Role.SAME if sign in (RowSign.MATCH, RowSign.UNKNOWN) else Role.DIFFERENCE
    yield Line(1, sign.value, _SAYS[sign], role, "event.sign")
    if row.elsewhere is not None:
        other, there = row.b is None, comparison.place_of(row.elsewhere, other=row.b is None)
        mark, name = "↓" if there > place else "↑", "b" if other else "a"
        words = f"in run {name} it stands {'below' if there > place else 'above'}: {row.elsewhere}"
        yield Line(
            1, mark, words, Role.LINK, "event.elsewhere", link=row.elsewhere, other_run=other
        )
    stamps = [
        Stamp(run.stamp(index), run.base_ns)
        for run, index in ((comparison.run_a, a), (comparison.run_b, b))
        if index is not None
    ]
    if len(set(stamps)) == 1:
        yield Line(1, "at", f"{format_seconds(stamps[0])} s", Role.FIELD, "event.at")
    else:
        later = format_duration(abs(stamps[1] - stamps[0]))
        which = "later" if stamps[1] > stamps[0] else "earlier"
        text = (
            f"{format_seconds(stamps[0])} s / {format_seconds(stamps[1])} s (b is {later} {which})"
        )
        yield Line(1, "at", text, Role.DIFFERENCE, "event.at")


def _why(comparison: Comparison) -> Iterator[Line]:
    """Yield the reason of the first divergence, as the diff has it."""
    if comparison.diff is None:
        yield Line(1, "why", "looking for the cause …", Role.NOTE, "why")
    elif (divergence := comparison.diff.shown) is not None:
        sentence = divergence.root_sentence or divergence.sentence
        yield Line(1, "why", printable(sentence), Role.NOTE, "why")
        if (absence := divergence.absence) is not None:
            text = printable(no_event_text(absence))
            yield Line(1, f"in {absence.run}", text, Role.NOTE, "why.absence")
        remarks = comparison.diff.remarks
        failed = [remark for remark in remarks if isinstance(remark, EndedByException)]
        for place, remark in enumerate(failed):
            yield Line(1, "!", printable(remark_text(remark)), Role.ERROR, f"why.{place}")


def chain_lines(comparison: Comparison, divergence: Divergence) -> Iterator[Line]:
    """Yield the way from the root to a divergence as a tree of links, root first."""
    if not divergence.chain:
        return
    yield Line(0, "cause chain", "root first", Role.SECTION, "chain")
    for depth, step in enumerate(divergence.chain):
        view = step.a or step.b
        if view is None:
            continue
        other = step.a is None
        sign = comparison.sign(comparison.place_of(view.index, other=other))
        words = (
            f"{view.index} {sign.value} {view.entity.node or RUN_NAME} {SHORT_KINDS[view.kind]} "
        )
        text = f"{words}{view.entity.name}"
        if relation := link_text(step.link):
            text += f", {relation}"
        yield Line(
            1 + depth,
            "└" if depth else "●",
            printable(text),
            Role.LINK,
            f"chain.{depth}",
            link=view.index,
            other_run=other,
        )


def _difference_lines(
    comparison: Comparison, a: int | None, b: int | None, openness: Openness, *, first: bool
) -> Iterator[Line]:
    runs = comparison.runs
    view_a = runs.view(a, of_b=False) if a is not None else None
    view_b = runs.view(b, of_b=True) if b is not None else None
    found = runs.differences(a, b)
    known = comparison.diff.shown if first and comparison.diff is not None else None
    beside = list(
        differing_state_lines((runs.run_a, runs.run_b), (view_a, view_b), known, openness)
    )
    if known is not None:
        beside += differing_call_lines(known.calls)
    if not found and not beside:
        yield Line(0, "messages", "the same in both", Role.SECTION, "diff")
    for place, message in enumerate(found):
        yield from message_difference_lines(message, f"diff.{place}", openness)
    yield from beside


def message_difference_lines(
    message: MessageDifference, path: str, openness: Openness
) -> Iterator[Line]:
    """Yield a message in which two events differ, with its fields."""
    what = "input" if message.position < 0 else f"output {message.position}"
    presence = ""
    if message.presence is not Presence.BOTH:
        presence = f", {message.presence.value}"
    is_open = openness.is_open(path, True)
    title = printable(f"{message.topic}  {message.type}{presence}").rstrip()
    yield Line(0, f"≠ {what}", title, Role.SECTION, path, is_open)
    if not is_open:
        return
    if reason := no_fields_text(message):
        yield Line(1, "", printable(reason), Role.NOTE, f"{path}.reason")
    if message.preview:
        yield Line(1, "", printable(message.preview), Role.FIELD, f"{path}.preview")
    for number, difference in enumerate(message.fields):
        yield from _field_lines(difference, f"{path}.{number}")
    if message.more_fields:
        text = f"… and {message.more_fields} more fields"
        yield Line(1, "", text, Role.NOTE, f"{path}.more")


def _field_lines(field: FieldDifference, path: str) -> Iterator[Line]:
    yield Line(1, "", printable(field.path), Role.DIFFERENCE, path)
    if field.elements is None or not field.first:
        yield Line(2, "a", printable(field.a), Role.FIELD, f"{path}.a")
        yield Line(2, "b", printable(field.b), Role.FIELD, f"{path}.b")
    else:
        for place, a, b in field.first[:_FIRST_SHOWN]:
            yield Line(2, f"[{place}]", printable(f"{a} | {b}"), Role.FIELD, f"{path}.{place}")
    if distance := distance_text(field):
        yield Line(2, "", distance, Role.NOTE, f"{path}.note")


def _cause_lines(comparison: Comparison, a: int | None, b: int | None) -> Iterator[Line]:
    shown = set()
    yield Line(0, "cause", "", Role.SECTION, "cause")
    for run, index, other in ((comparison.run_a, a, False), (comparison.run_b, b, True)):
        if index is None:
            continue
        cause = int(run.row(index)["cause_event"])
        if not 0 <= cause < run.count:
            continue
        place = comparison.place_of(cause, other=other)
        if place in shown:
            continue
        shown.add(place)
        sign = comparison.sign(place)
        link = event_link(run, cause, f"cause.{'b' if other else 'a'}")
        yield Line(
            1, f"→ {sign.value}", link.value, Role.LINK, link.path, link=cause, other_run=other
        )
    if not shown:
        yield Line(1, "", "no other event", Role.NOTE, "cause.none")
