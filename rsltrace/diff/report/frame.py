"""What all reports begin and end with: verdict, the two files, notes, the next command."""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.diff.report.line import Line, Piece, Section, Style, line, side_lines, wrapped
from rsltrace.model.printable import printable
from rsltrace.words.phrases import as_sentence

_SENTENCE_LINES = 6
_NOTES_LEAST = 2


def head_lines(
    sentence: str, sides: Sequence[Sequence[Piece]], verdict: str, width: int, *, good: bool
) -> list[Line]:
    """Return the sentence, a line of facts for each file and the verdict (if any).

    Facts are path, kind or size, and so on; the first four stay whatever the width.
    """
    style = Style.GOOD if good else Style.BAD
    lines = wrapped(as_sentence(sentence), width, style=style)
    if len(lines) > _SENTENCE_LINES:
        lines = lines[:_SENTENCE_LINES]
        lines[-1] = line((lines[-1][0][0][: width - 1] + "…", style))
    names: tuple[Piece, Piece] = (("a", Style.SIDE_A), ("b", Style.SIDE_B))
    named = [[name, *facts] for name, facts in zip(names, sides, strict=True)]
    lines += side_lines(named, width, kept=5)
    if verdict:
        lines += wrapped(f"  verdict: {verdict}", width, indent="  ")
    return lines


def notes_section(notes: Sequence[str], width: int) -> Section:
    """Return what else to know of the comparison."""
    rows = [
        row
        for note in notes
        for row in wrapped(f"note: {printable(note)}", width, style=Style.TITLE, indent="  ")
    ]
    return Section((), rows, min(len(rows), _NOTES_LEAST), "notes")


def next_section(command: str, *before: str, width: int) -> Section:
    """Return the command to run next, if there is one, below lines of text.

    It is one line, however long: that is what can be copied.
    """
    rows = [line(text) for text in before]
    if command:
        rows.append(line(("next: ", Style.TITLE), (printable(command), Style.COMMAND)))
    wraps = sum(max(len("".join(text for text, _ in row)) - 1, 0) // width for row in rows)
    return Section((), rows, len(rows), "", len(rows), wraps=wraps)
