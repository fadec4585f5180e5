"""Several runs against one golden run: which diverge where, as a table."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from rsltrace.diff.report.events import event_text
from rsltrace.diff.report.line import Line, Piece, Style, in_columns, line
from rsltrace.diff.result.bags import BagDiff
from rsltrace.diff.result.traces import Diff
from rsltrace.diff.result.verdicts import ENDED_BY_EXCEPTION
from rsltrace.model.printable import printable
from rsltrace.model.stamp import format_seconds

COLUMNS = ("run", "verdict", "event", "time", "where")


def several_cells(diff: Diff | BagDiff) -> tuple[str, str, str, str, str]:
    """Return what the table says of one run, in the order of ``COLUMNS``."""
    path = printable(diff.b.path)
    if isinstance(diff, BagDiff):
        if diff.first is None:
            lone = (*diff.topics_only_a, *diff.topics_only_b)
            where = printable(lone[0].topic) if lone else ""
            return path, diff.verdict.value, "", "", where
        shown = diff.first.a or diff.first.b
        index = "" if shown is None else str(shown.index)
        time = format_seconds(diff.first.after_ns)
        return path, diff.verdict.value, index, time, printable(diff.first.topic)
    if not diff.divergences:
        return path, diff.verdict.value, "", "", ""
    found = diff.divergences[0]
    event = found.b or found.a
    verdict = f"{diff.verdict.value}{' (within tolerance)' if diff.within_tolerance else ''}"
    if event is None:
        return path, verdict, str(diff.agreeing), "", ""
    return path, verdict, str(event.index), format_seconds(event.stamp_ns), event_text(event)


def how_many_diverge(diffs: Sequence[Diff | BagDiff]) -> str:
    """Return ``2 of 3 runs diverge``."""
    count = sum(diff.diverged for diff in diffs)
    return f"{count} of {len(diffs)} runs diverge{'s' if count == 1 else ''}"


def several_report(diffs: Sequence[Diff | BagDiff]) -> list[Line]:
    """Return the table of several runs, with a sentence that counts them first.

    Nothing in it is cut: it is made to be read by ``grep`` and ``awk``, too.
    """
    diverged = sum(diff.diverged for diff in diffs)
    golden = printable(diffs[0].a.path)
    if diverged:
        sentence = f"{how_many_diverge(diffs)} from {golden}."
    else:
        near = sum(diff.within_tolerance for diff in diffs)
        within = f", {near} of them within tolerance" if near else ""
        sentence = f"All {len(diffs)} runs agree with {golden}{within}."
    rows: list[list[Piece]] = [[(name, Style.FAINT) for name in COLUMNS]]
    for diff in diffs:
        path, *rest = several_cells(diff)
        style = Style.BAD if diff.diverged else Style.GOOD
        rows.append([(path, ""), (rest[0], style), *((text, "") for text in rest[1:])])
    lines = [line((sentence, Style.BAD if diverged else Style.GOOD)), line()]
    lines += in_columns(rows, indent="", widest=60)
    if failed := [text for diff in diffs if (text := _failure(diff))]:
        lines += [line(), *(line((text, Style.BAD)) for text in failed)]
    first = next((diff for diff in diffs if diff.diverged), None)
    if first is not None:
        command = shlex.join(["rsltrace", "diff", first.a.path, first.b.path])
        lines += [line(), line(("next: ", Style.TITLE), printable(command))]
    return lines


def _failure(diff: Diff | BagDiff) -> str:
    """Return which exception ended a run that the golden one did not end with."""
    note = next((note for note in diff.notes if note.startswith(f"b {ENDED_BY_EXCEPTION}")), "")
    return f"{printable(diff.b.path)}{printable(note[1:])}" if note else ""
