"""Differences of messages in words: which message, which fields, and how far apart they are."""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.diff.facts.evidence import ULP_SHOWN_MAX, FieldDifference, MessageDifference, Presence
from rsltrace.diff.report.line import Line, Piece, Style, cut, in_columns, line, wrapped
from rsltrace.diff.sentences.values import notes_text, output_change_text
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.texts import counted, printable, shortened
from rsltrace.trace.words.code import places_text

_INDENT = "    "
_INLINE_MAX = 26
_PATH_MAX = 36
_VERBS = {
    OutputKind.MESSAGE: "message on",
    OutputKind.REQUEST: "request to",
    OutputKind.RESPONSE: "response of",
    OutputKind.LOG: "log record on",
}
_NOT_SAID = (OutputKind.ENTITY, OutputKind.DRAW, *_VERBS)
_TYPED = (None, OutputKind.ENTITY, *_VERBS)


def message_title(message: MessageDifference) -> str:
    """Return ``output 0: message on /odom (nav_msgs/msg/Odometry)``, with who has it."""
    if message.kind is None:
        what = "input"
    else:
        verb = _VERBS.get(message.kind, message.kind.label)
        what = f"output {message.position}:" if message.position >= 0 else "input:"
        if message.kind in _NOT_SAID:  # others say what they are
            what = f"{what} {verb}"
    text = f"{what} {printable(message.topic)}".rstrip()
    if message.type and message.kind in _TYPED:
        text += f" ({printable(message.type)})"
    if message.kind is OutputKind.TIMER and message.fate is not None:
        text += f", {output_change_text(message)}"
    elif message.presence is not Presence.BOTH:
        text += f", {message.presence.value}"
    if message.code:
        text += f", at {printable(places_text(list(message.code)))}"
    return text


def hashes_text(message: MessageDifference) -> str:
    """Return the hashes of both sides, for what has no payload."""
    sides = ("absent" if h is None else f"{h:016x}" for h in (message.hash_a, message.hash_b))
    return " | ".join(sides)


def distance_text(difference: FieldDifference) -> str:
    """Return how far apart the values are, and what is special about them."""
    parts = []
    if difference.elements is not None and difference.elements[0] > 1:
        parts.append(f"{difference.elements[0]} of {difference.elements[1]} differ")
    if difference.absolute is not None:
        parts.append(f"|a-b| {difference.absolute:.6g}")
    if difference.smallest is not None and difference.largest is not None:
        if difference.smallest == difference.largest:
            parts.append(f"|a-b| {difference.largest:.6g}")
        else:
            parts.append(f"|a-b| {difference.smallest:.6g} to {difference.largest:.6g}")
    if difference.ulp is not None and difference.ulp <= ULP_SHOWN_MAX:
        several = difference.elements is not None and difference.elements[0] > 1
        parts.append(f"{'up to ' if several else ''}{difference.ulp} ulp")
    if difference.notes:
        parts.append(notes_text(difference))
    if difference.within_tolerance:
        parts.append("within tolerance")
    return ", ".join(parts)


def payload_lines(
    fields: Sequence[FieldDifference], more_fields: int, preview: str, reason: str, width: int
) -> list[Line]:
    """Return what differs in a message: its fields, or the message itself where one side has it,
    or the reason why nothing can be said."""
    rows = _field_lines(fields, width)
    if more_fields:
        rows.append(line((f"{_INDENT}… {counted(more_fields, 'more field')}", Style.FAINT)))
    if preview:
        rows.append(line(f"{_INDENT}{shortened(printable(preview), width - len(_INDENT))}"))
    if reason:
        rows += wrapped(f"{_INDENT}{printable(reason)}", width, style=Style.FAINT, indent=_INDENT)
    return rows


def _field_lines(differences: Sequence[FieldDifference], width: int) -> list[Line]:
    """Return lines for differing fields: short values side by side, others below each other."""
    paths = min(max((len(found.path) for found in differences), default=0), _PATH_MAX)
    inline_max = min(_INLINE_MAX, (width - paths - 11) // 2)  # what differs must not be cut off
    rows = []
    for found in differences:
        path = (printable(found.path), "")
        if found.first:
            rows.append([path, (distance_text(found), "")])
            rows += _element_rows(found)
        elif max(len(found.a), len(found.b)) <= inline_max:
            distance = (distance_text(found), Style.FAINT)
            rows.append(
                [
                    path,
                    (found.a, Style.SIDE_A),
                    ("|", Style.FAINT),
                    (found.b, Style.SIDE_B),
                    distance,
                ]
            )
        else:
            rows.append([path, (distance_text(found), Style.FAINT)])
            room = max(width - len(_INDENT) - 6, 20)
            rows.append([(f"  a {shortened(found.a, room)}", Style.SIDE_A)])
            rows.append([(f"  b {shortened(found.b, room)}", Style.SIDE_B)])
    return [cut(row, width) for row in in_columns(rows, indent=_INDENT, widest=_PATH_MAX)]


def _element_rows(found: FieldDifference) -> list[list[Piece]]:
    """Return the first elements that differ; bytes below each other, as in a hex dump."""
    if any(max(len(a), len(b)) > _INLINE_MAX for _, a, b in found.first):
        rows: list[list[Piece]] = []
        for place, a, b in found.first:
            label = f"{place:#06x}" if found.binary else f"[{place}]"
            rows.append([(f"  {label} a {a}", Style.SIDE_A)])
            rows.append([(f"  {' ' * len(label)} b {b}", Style.SIDE_B)])
        return rows
    texts = [f"[{place}] {a} | {b}" for place, a, b in found.first]
    return [[(f"  {',  '.join(texts)}", "")]]
