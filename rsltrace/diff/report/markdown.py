"""A diff as Markdown, for a comment on a pull request."""

from __future__ import annotations

import re
from collections.abc import Sequence

from rsltrace.diff.facts.evidence import FieldDifference
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report.differences import distance_text, message_title
from rsltrace.diff.report.line import plain_text
from rsltrace.diff.report.several import COLUMNS, how_all_agree, how_many_fail, several_cells
from rsltrace.diff.report.text import report_lines
from rsltrace.diff.result import BagDiff, Diff
from rsltrace.trace.model.texts import counted, printable, shortened
from rsltrace.trace.words.phrases import as_sentence

_SPECIAL = re.compile(r"([\\`*_\[\]<>|#~@])")
_FENCE = re.compile(r"`{3,}")
_FIELDS = 10
_CELL = 60


def markdown(diff: Diff | BagDiff, options: DiffOptions, level: int = 3) -> str:
    """Return a heading with the verdict, a table of the fields that differ, and the full report
    folded away."""
    lines = [
        f"{'#' * level} rsltrace: {_heading(diff)}",
        "",
        _escaped(as_sentence(diff.sentence)),
        "",
    ]
    lines += _sides(diff)
    lines += _fields(diff)
    if not diff.identical:
        report = report_lines(diff, options)
        lines += ["<details><summary>Full report</summary>", "", *code_block(plain_text(report))]
        lines += ["", "</details>", ""]
    return "\n".join(lines).rstrip() + "\n"


def several_markdown(diffs: Sequence[Diff | BagDiff], options: DiffOptions) -> str:
    """Return a table of all runs, and below it those that diverge."""
    failed = [diff for diff in diffs if diff.failed]
    verdict = how_many_fail(diffs) if failed else how_all_agree(diffs)
    lines = [f"### rsltrace: {verdict}", "", f"Golden: {_code_span(diffs[0].a.path)}", ""]
    lines += _table(COLUMNS, [several_cells(diff) for diff in diffs])
    text = "\n".join(lines) + "\n"
    return text + "".join("\n" + markdown(diff, options, level=4) for diff in failed)


def _heading(diff: Diff | BagDiff) -> str:
    if diff.identical:
        return "identical" if isinstance(diff, Diff) else "equal"
    if isinstance(diff, BagDiff) or diff.agrees_until_cut:
        return str(diff.verdict.value)
    tolerated = " (equal within tolerance, not identical)" if diff.within_tolerance else ""
    return f"the runs diverge: {diff.verdict.value}{tolerated}"


def _sides(diff: Diff | BagDiff) -> list[str]:
    if isinstance(diff, Diff):
        rows = [
            (name, side.path, str(side.events), side.digest)
            for name, side in (("a", diff.a), ("b", diff.b))
        ]
        return [*_table(("", "trace", "events", "digest"), rows), ""]
    recordings = [
        (name, side.path, side.kind, str(side.messages))
        for name, side in (("a", diff.a), ("b", diff.b))
    ]
    return [*_table(("", "recording", "kind", "messages"), recordings), ""]


def _fields(diff: Diff | BagDiff) -> list[str]:
    """Return tables of the fields that differ at the first divergence."""
    found: list[tuple[str, tuple[FieldDifference, ...], int]] = []
    if isinstance(diff, BagDiff):
        if diff.first is not None:
            found.append((diff.first.topic, diff.first.fields, diff.first.more_fields))
    elif diff.shown is not None:
        for message in diff.shown.messages:
            found.append((message_title(message), message.fields, message.more_fields))
    lines = []
    for title, fields, more in found:
        if not fields:
            continue
        rows = [(one.path, one.a, one.b, distance_text(one)) for one in fields[:_FIELDS]]
        more += len(fields) - len(rows)
        lines += [f"**{_escaped(title)}**", "", *_table(("field", "a", "b", ""), rows), ""]
        if more:
            lines += [f"… {counted(more, 'more field')}", ""]
    return lines


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [f"| {' | '.join(header)} |", f"|{'---|' * len(header)}"]
    for row in rows:
        cells = (_escaped(shortened(cell, _CELL)) for cell in row)
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _escaped(text: str) -> str:
    """Return text that Markdown shows as it is: what a trace says is no markup and no mention."""
    return _SPECIAL.sub(r"\\\1", printable(text))


def _code_span(text: str) -> str:
    return f"`{printable(text).replace('`', chr(39))}`"


def code_block(text: str) -> list[str]:
    """Return text as the lines of a block of code, which it cannot end."""
    longest = max((len(run) for run in _FENCE.findall(text)), default=2)
    fence = "`" * (longest + 1)
    return [f"{fence}text", text.rstrip("\n"), fence]
