"""Several runs against one golden run: which diverge where, as a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rsltrace.diff.facts.remarks import EndedByException
from rsltrace.diff.report.divergence import event_text
from rsltrace.diff.report.line import Line, Piece, Style, in_columns, line
from rsltrace.diff.result import BagDiff, Diff
from rsltrace.diff.sentences.runs import remark_text
from rsltrace.trace.model.texts import format_seconds, printable
from rsltrace.trace.words.phrases import as_sentence, path_word

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
    found = diff.shown
    if found is None:
        return path, diff.verdict.value, "", "", ""
    event = found.b or found.a
    verdict = f"{diff.verdict.value}{' (within tolerance)' if diff.within_tolerance else ''}"
    if event is None:
        return path, verdict, str(diff.agreeing), "", ""
    return path, verdict, str(event.index), format_seconds(event.stamp_ns), event_text(event)


def how_many_fail(diffs: Sequence[Diff | BagDiff], golden: str = "") -> str:
    """Return ``2 of 3 runs diverge from GOLDEN``, and how many are cut."""
    diverged = sum(diff.diverged for diff in diffs)
    cut = sum(diff.failed and diff.agrees_until_cut for diff in diffs)
    said = f"{diverged} of {len(diffs)} runs diverge{'s' if diverged == 1 else ''}"
    said += f" from {golden}" if golden else ""
    of = "" if diverged else f" of {len(diffs)} runs"
    also = f"{cut}{of} agree{'s' if cut == 1 else ''} only up to where a recording is truncated"
    return also if not diverged else f"{said}, {also}" if cut else said


def how_all_agree(diffs: Sequence[Diff | BagDiff], golden: str = "") -> str:
    """Return ``all runs agree``, and how many are cut."""
    cut = sum(diff.agrees_until_cut for diff in diffs)
    agree = f"all {len(diffs)} runs agree with {golden}" if golden else "all runs agree"
    return agree + (f", {cut} of them only up to where a recording is truncated" if cut else "")


def several_report(diffs: Sequence[Diff | BagDiff]) -> list[Line]:
    """Return the table of several runs, with a sentence that counts them first.

    Nothing in it is cut: it is made to be read by ``grep`` and ``awk``, too.
    """
    failed = sum(diff.failed for diff in diffs)
    golden = printable(diffs[0].a.path)
    if failed:
        sentence = f"{how_many_fail(diffs, golden)}."
    else:
        near = sum(diff.within_tolerance for diff in diffs)
        within = f", {near} of them within tolerance" if near else ""
        sentence = as_sentence(f"{how_all_agree(diffs, golden)}{within}")
    rows: list[list[Piece]] = [[(name, Style.FAINT) for name in COLUMNS]]
    for diff in diffs:
        path, *rest = several_cells(diff)
        style = Style.BAD if diff.failed else Style.GOOD
        rows.append([(path, ""), (rest[0], style), *((text, "") for text in rest[1:])])
    lines = [line((sentence, Style.BAD if failed else Style.GOOD)), line()]
    lines += in_columns(rows, indent="", widest=60)
    if ended := [text for diff in diffs if (text := _failure(diff))]:
        lines += [line(), *(line((text, Style.BAD)) for text in ended)]
    first = next((diff for diff in diffs if diff.failed), None)
    if first is not None:
        command = f"rsltrace diff {path_word(first.a.path)} {path_word(first.b.path)}"
        lines += [line(), line(("next: ", Style.TITLE), printable(command))]
    return lines


def _failure(diff: Diff | BagDiff) -> str:
    """Return which exception ended a run that the golden one did not end with."""
    ended = (r for r in diff.remarks if isinstance(r, EndedByException) and r.run == "b")
    found = next((replace(one, run=diff.b.path) for one in ended), None)
    return "" if found is None else printable(remark_text(found))
