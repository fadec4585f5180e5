"""Lines of a report as pieces of styled text, so that one layout serves terminal and pipe.

A style says what a piece is, not what it looks like; without colours the text alone must do.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from textwrap import wrap

from rsltrace.model.printable import shortened


class Style:
    """What a piece is."""

    PLAIN = ""
    TITLE = "title"
    GOOD = "good"
    BAD = "bad"
    SIDE_A = "a"
    SIDE_B = "b"
    FAINT = "faint"
    COMMAND = "command"


HEIGHT = 40
"""Lines of a report unless more is asked for, or the terminal says otherwise."""

_PATH_LEAST = 20
"""Characters of a path that stay: enough to tell the files of one folder apart."""

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
    """Return rows with aligned columns, two spaces apart; the last column has any width.

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
    paths, then what is behind the first ``kept`` cells.
    """

    def columns(cells: Sequence[Sequence[Piece]]) -> tuple[list[Line], int]:
        lines = in_columns(cells, widest=60)
        return lines, max(map(_length, lines)) - width

    lines, over = columns(rows)
    if over > 0 and rows[0][-1] == rows[-1][-1]:
        rows = [row[:-1] for row in rows]
        lines, over = columns(rows)
    if over > 0:
        room = max(max(len(row[1][0]) for row in rows) - over, _PATH_LEAST)
        rows = [[row[0], (_ending(row[1][0], room), row[1][1]), *row[2:]] for row in rows]
        lines, over = columns(rows)
    least = max(map(_length, in_columns([row[:kept] for row in rows], widest=60)))
    return [cut(row, max(width, least)) for row in lines]


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
    left out is not worth a line). ``drop`` says where rows go: ``last``, ``first`` or ``middle``.
    """

    title: Line
    rows: list[Line]
    keep: int
    noun: str
    least: int = 1
    drop: str = "last"
    hidden: int = field(default=0)

    @property
    def height(self) -> int:
        """Lines it takes, the blank one before it included."""
        if not self.rows and (self.hidden or not self.title):
            return 0
        return 1 + bool(self.title) + len(self.rows) + bool(self.hidden and self.noun)

    def lines(self) -> list[Line]:
        """Return the lines, a blank one first."""
        if not self.height:
            return []
        noun = self.noun if self.hidden != 1 else _singular(self.noun)
        more = (
            [line((f"  … {self.hidden} more {noun}", Style.FAINT))] if self.hidden and noun else []
        )
        gap = {"first": 0, "middle": (len(self.rows) + 1) // 2}.get(self.drop, len(self.rows))
        rows = [*self.rows[:gap], *more, *self.rows[gap:]]
        return [BLANK, *([self.title] if self.title else []), *rows]

    def spare(self, *, hard: bool) -> int:
        """Return how many rows could go; ``hard`` if it must be."""
        return len(self.rows) - (min(self.keep, self.least) if hard else self.keep)

    def shorten(self) -> None:
        """Leave out the row that matters least."""
        self.rows.pop({"first": 0, "middle": len(self.rows) // 2}.get(self.drop, -1))
        self.hidden += 1


def _singular(noun: str) -> str:
    return noun[:-3] + "y" if noun.endswith("ies") else noun.removesuffix("s")


NOTHING = Section((), [], 0, "")
"""A section without lines."""


def fitted(head: list[Line], sections: Sequence[Section], height: int | None) -> list[Line]:
    """Return head and sections in at most ``height`` lines (None: all of them), if they can be.

    The section that has most to spare is shortened first; each says how much it leaves out.
    """

    for hard in (False, True):
        while height is not None and len(head) + sum(part.height for part in sections) > height:
            part = max(sections, key=lambda part: part.spare(hard=hard))
            if part.spare(hard=hard) <= 0:
                break
            part.shorten()
    return [*head, *(row for part in sections for row in part.lines())]
