"""Lines of a report as pieces of styled text, so that one layout serves terminal and pipe.

A style says what a piece is, not its colour; the text must do without colours.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import field
from textwrap import wrap

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.texts import printable, shortened
from rsltrace.trace.words.phrases import as_sentence


class Style:
    PLAIN = ""
    TITLE = "title"
    GOOD = "good"
    BAD = "bad"
    SIDE_A = "a"
    SIDE_B = "b"
    FAINT = "faint"
    COMMAND = "command"


HEIGHT = 40
"""Lines of a report by default, unless the terminal has another height."""

_PATH_LEAST = 20
"""Characters of a path that stay: enough to distinguish the files of one folder."""

_PATH_SHORT = 10
"""Characters that stay in a very narrow terminal."""

Piece = tuple[str, str]
"""(text, style)"""
Line = tuple[Piece, ...]

BLANK: Line = ()


def line(*pieces: str | Piece) -> Line:
    """Return a line of pieces; a bare text has no style."""
    return tuple((piece, Style.PLAIN) if isinstance(piece, str) else piece for piece in pieces)


def plain_text(lines: Iterable[Line]) -> str:
    """Return the lines as text that ends in a newline, without any colour."""
    return "".join(f"{''.join(text for text, _ in row).rstrip()}\n" for row in lines)


def wrapped(text: str, width: int, *, style: str = Style.PLAIN, indent: str = "") -> list[Line]:
    """Return a sentence as lines of at most ``width`` characters; paths are not broken."""
    rows = wrap(
        text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return [line((row, style)) for row in rows]


def in_columns(
    rows: Sequence[Sequence[Piece]], *, indent: str = "  ", widest: int = 40
) -> list[Line]:
    """Return rows with aligned columns, two spaces between them; the last column has any width.

    A cell wider than ``widest`` pushes the rest of its row to the right instead of all rows.
    """
    if not rows:
        return []
    count = max(map(len, rows))
    widths = [
        max((min(len(row[at][0]), widest) for row in rows if at < len(row) - 1), default=0)
        for at in range(count)
    ]
    lines = []
    for row in rows:
        pieces: list[Piece] = [(indent, Style.PLAIN)]
        for at, (text, style) in enumerate(row):
            last = at == len(row) - 1
            pieces.append((text if last else f"{text:<{widths[at]}}", style))
            if not last:
                pieces.append(("  ", Style.PLAIN))
        lines.append(tuple(pieces))
    return lines


def side_lines(rows: Sequence[Sequence[Piece]], width: int, *, kept: int) -> list[Line]:
    """Return what is said of the two files, one line each: name, path, then facts.

    Where that is wider than ``width``, first what both end with goes, then the beginning of the
    paths, then what is behind the first ``kept`` cells, then more of the paths.
    """

    def columns(cells: Sequence[Sequence[Piece]]) -> tuple[list[Line], int]:
        lines = in_columns(cells, widest=60)
        return lines, max(map(_length, lines)) - width

    lines, over = columns(rows)
    if over > 0 and rows[0][-1] == rows[-1][-1]:
        rows = [row[:-1] for row in rows]
        lines, over = columns(rows)
    for least in (_PATH_LEAST, _PATH_SHORT):
        if over > 0:
            room = max(max(len(row[1][0]) for row in rows) - over, least)
            rows = [[row[0], (_ending(row[1][0], room), row[1][1]), *row[2:]] for row in rows]
            lines, over = columns(rows)
        if over > 0:
            short = zip(rows, lines, strict=True)
            rows = [row if _length(shown) <= width else row[:kept] for row, shown in short]
            lines, over = columns(rows)
    return lines


def _length(row: Line) -> int:
    return len("".join(text for text, _ in row).rstrip())


def _ending(path: str, room: int) -> str:
    return path if len(path) <= room else "…" + path[len(path) - room + 1 :]


def cut(row: Line, width: int) -> Line:
    """Return a line without what is beyond ``width``; an ellipsis marks the cut."""
    length = sum(len(text) for text, _ in row)
    if length <= width:
        return row
    pieces: list[Piece] = []
    room = width
    for text, style in row:
        if len(text) >= room:
            pieces.append((shortened(text, room) if len(text) > room else text, style))
            if len(text) > room:
                break
        else:
            pieces.append((text, style))
        room -= len(text)
        if room <= 0:
            break
    return line(*pieces)


@dataclass(slots=True)
class Section:
    """Some lines under a title that may be shortened when space is short.

    ``keep`` rows are kept if that is possible at all, ``least`` in any case; a section shortened
    to no row disappears. ``noun`` names what the rows show: ``… 7 more fields`` (empty: what is
    left out is not worth a line). ``drop`` says where rows go: ``last``, ``first`` or ``middle``;
    the first ``fixed`` ones stay. Of sections with a ``rank`` the highest is left out first when
    all that is not enough. ``wraps`` is how many lines a terminal adds by wrapping.
    """

    title: Line
    rows: list[Line]
    keep: int
    noun: str
    least: int = 1
    drop: str = "last"
    hidden: int = field(default=0)
    rank: int = 0
    fixed: int = 0
    wraps: int = 0
    left_out: bool = field(default=False)

    @property
    def height(self) -> int:
        """Lines it takes, the blank one before it included."""
        shown = len(self.rows) - self.hidden
        if self.left_out or (not shown and (self.hidden or not self.title)):
            return 0
        return 1 + bool(self.title) + shown + bool(self.hidden and self.noun) + self.wraps

    def lines(self) -> list[Line]:
        """Return the lines, a blank one first."""
        if not self.height:
            return []
        more = [line((f"  … {self.hidden} more {self.noun}", Style.FAINT))]
        rest = self.rows[self.fixed :]
        kept = len(rest) - self.hidden
        before = {"first": 0, "middle": (kept + 1) // 2}.get(self.drop, kept)
        rows = [
            *self.rows[: self.fixed],
            *rest[:before],
            *(more if self.hidden and self.noun else ()),
            *rest[len(rest) - kept + before :],
        ]
        return [BLANK, *([self.title] if self.title else []), *rows]

    def spare(self, *, hard: bool) -> int:
        """Return how many rows could go; ``hard`` if it must be."""
        keep = max(min(self.keep, self.least) if hard else self.keep, self.fixed)
        return len(self.rows) - self.hidden - keep


NOTHING = Section((), [], 0, "")
"""A section without lines."""

_SENTENCE_LINES = 6
_NOTES_LEAST = 2
_LEFT_OUT = line(("… a taller terminal or | less shows more", Style.FAINT))


def fitted(head: list[Line], sections: Sequence[Section], height: int | None) -> list[Line]:
    """Return head and sections in at most ``height`` lines (None: all of them), if they can be.

    The section that has most to spare is shortened first; each says how much it leaves out. Then
    whole sections go, those that matter least first. What has room after all comes back: nothing is
    left out to save a line. The last section is the next step, and always there.
    """
    *others, last = [part for part in sections if part is not NOTHING] or [NOTHING]

    def fits() -> bool:
        has_note = any(part.left_out for part in others)
        lines = len(head) + sum(part.height for part in (*others, last)) + has_note
        return height is None or lines <= height

    for hard in (False, True):
        while not fits():
            part = max(others, key=lambda part: part.spare(hard=hard), default=last)
            if part.spare(hard=hard) <= 0:
                break
            part.hidden += 1
    while not fits() and (ranked := [part for part in others if part.rank and part.height]):
        max(ranked, key=lambda part: part.rank).left_out = True
    by_rank = sorted(others, key=lambda part: part.rank)
    for part in by_rank:
        if part.left_out:
            part.left_out = False
            part.left_out = not fits()
    for part in by_rank:
        while part.hidden and not part.left_out:
            part.hidden -= 1
            if not fits() and not (part.noun and not part.hidden):
                part.hidden += 1
                break
    lines = [*head, *(row for part in others for row in part.lines())]
    ending = last.lines()
    if any(part.left_out for part in others):
        ending.insert(1, _LEFT_OUT)
    return [*lines, *ending]


# -- what all reports begin and end with -----------------------------------------------------------


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
