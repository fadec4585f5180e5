"""The report of two traces as a person reads it: verdict first, on one screen."""

from __future__ import annotations

from itertools import takewhile

from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report.divergence import CONTEXT, divergence_sections
from rsltrace.diff.report.line import (
    BAD,
    BLANK,
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
from rsltrace.diff.report.words import sentence_text
from rsltrace.diff.traces.model import Diff, Divergence, Setting, Side
from rsltrace.model.printable import printable, shortened
from rsltrace.model.stamp import format_seconds

_UP_TO_DIGEST = 5
_SENTENCE_LINES = 3
_ALIKE_SHOWN = 12
_ALL_HINT = "--all shows them"


def trace_report(
    diff: Diff, options: DiffOptions, width: int = 100, height: int = HEIGHT
) -> list[Line]:
    """Return the report of two traces, at most ``height`` lines unless ``options.everything``."""
    head = _head(diff, width)
    hidden = any(note.endswith(_ALL_HINT) for note in diff.notes)
    # First what else to know of the comparison: that the jobs are different ones, or a file cut.
    before = _notes([note for note in diff.notes if not note.endswith(_ALL_HINT)], width)
    if not diff.divergences:
        return fitted(head, [before, _settings(diff, width)], None)
    first, *others = diff.divergences
    sections = [
        before,
        *divergence_sections(first, width, options),
        _afterwards(diff, width),
        _settings(diff, width),
    ]
    if not options.everything:
        # Whoever asks for a longer context wants to see it.
        height += 2 * max(options.context - CONTEXT, 0)
        return fitted(head, [*sections, _next(first, len(others), hidden=hidden)], height)
    lines = fitted(head, [*sections, _next(first, 0)], None)
    for number, other in enumerate(others, start=2):
        lines += [BLANK, line((f"independent divergence {number}: {other.verdict.value}", TITLE))]
        lines += wrapped(sentence_text(other.sentence), width, style=BAD)
        lines += fitted([], [*divergence_sections(other, width, options), _next(other, 0)], None)
    return lines


def _head(diff: Diff, width: int) -> list[Line]:
    style = GOOD if diff.identical else BAD
    lines = wrapped(sentence_text(diff.sentence), width, style=style)
    if len(lines) > _SENTENCE_LINES:
        lines = lines[:_SENTENCE_LINES]
        lines[-1] = line((lines[-1][0][0][: width - 1] + "…", style))
    sides = [("a", SIDE_A, diff.a), ("b", SIDE_B, diff.b)]
    lines += side_lines([_side_cells(*side) for side in sides], width, kept=_UP_TO_DIGEST)
    if not diff.identical:
        agree = f"the first {diff.agreeing} events agree"
        if diff.agreeing < 2:
            agree = "the first event agrees" if diff.agreeing else "no event before agrees"
        verdict = f"  verdict: {diff.verdict.value}; {agree}"
        lines += wrapped(verdict, width, indent="  ")
        lines += _tolerance(diff, width)
    return lines


def _tolerance(diff: Diff, width: int) -> list[Line]:
    if diff.tolerance is None:
        return []
    if diff.within_tolerance:
        how = "but for what is ignored" if diff.tolerance.identical else "within tolerance"
        text = f"equal {how}, not identical: the digests differ"
    else:
        said = printable(diff.tolerance.sentence).replace("The recordings", "the messages", 1)
        text = f"not within tolerance: {said}"
    return wrapped(f"  {text}", width, style=TITLE, indent="    ")


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
                (printable(str(setting)), ""),
                (a, SIDE_A),
                ("|", FAINT),
                (b, SIDE_B),
            ]
            for setting in diff.settings
            for a, b in [_values(setting, room)]
        ],
        widest=max(room, 34),
    )
    title: Piece = ("job and environment differ", TITLE)
    if len(rows) == 1:
        (row,) = rows
        return Section((), [cut(line(title, ": ", *row[1:]), width)], 1, "settings")
    return Section(line(title), rows, 2, "settings")


def _values(setting: Setting, room: int) -> tuple[str, str]:
    """Return both values in ``room`` characters each: of long ones, what differs."""
    a, b = ("-" if v is None else printable(v.strip()) for v in (setting.a, setting.b))
    alike = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(a, b, strict=False)))
    if max(len(a), len(b)) > room and alike > _ALIKE_SHOWN:
        a, b = (f"…{text[alike - _ALIKE_SHOWN :]}" for text in (a, b))
    return shortened(a, room), shortened(b, room)


def _notes(notes: list[str], width: int) -> Section:
    rows = [
        row
        for note in notes
        for row in wrapped(f"note: {printable(note)}", width, style=TITLE, indent="  ")
    ]
    return Section((), rows, min(len(rows), 2), "notes")


def _next(found: Divergence, others: int, *, hidden: bool = False) -> Section:
    rows = []
    if others:
        count = f"more than {others}" if hidden else str(others)
        word = "divergence" if count == "1" else "divergences"
        rows.append(line(f"{count} further independent {word}: {_ALL_HINT}"))
    if found.next_step:
        rows.append(line(("next: ", TITLE), (printable(found.next_step), COMMAND)))
    return Section((), rows, len(rows), "", len(rows))
