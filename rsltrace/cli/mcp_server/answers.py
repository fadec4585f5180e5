"""Answers of a bounded size, in which recorded text is marked and cannot pass for anything else."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rsltrace.trace.model.texts import printable, shortened

ANSWER_BYTES_MAX = 8000
_PREFIX_BYTES = 100
"""Room for what the package mcp puts before errors."""
_LINES_BYTES_MAX = 6400
_LINE_MAX = 400
_TITLE_MAX = 600
_NEXT_MAX = 240
_NEXT_COUNT = 3
_MARK = "| "
"""Before each line that a trace, job, node or command has said. No such text can begin a line."""


@dataclass(frozen=True, slots=True)
class Page:
    """Lines of a longer text: how many there are before and after them."""

    lines: tuple[str, ...] = ()
    before: int = 0
    after: int = 0


class PageKeeper:
    """Keeps a page of a text that comes in pieces, however long it is or its lines are.

    The page begins with line ``skip``; with ``end``, it has the last lines.
    """

    def __init__(self, *, skip: int = 0, end: bool = False) -> None:
        self._skip = skip
        self._end = end
        self._lines: deque[str] = deque()
        self._bytes = 0
        self._count = 0
        self._partial = b""

    def feed(self, data: bytes) -> None:
        """Add the next bytes."""
        *whole, partial = (self._partial + data).split(b"\n")
        for line in whole:
            self.add(line.decode("utf-8", "backslashreplace"))
        self._partial = partial[: 4 * _LINE_MAX]

    def add(self, line: str) -> None:
        self._count += 1
        is_full = not self._end and self._count - self._skip > len(self._lines) + 1
        if self._count <= self._skip or is_full:
            return
        line = shortened(printable(line.rstrip().expandtabs()), _LINE_MAX)
        self._bytes += _size(line)
        if self._bytes > _LINES_BYTES_MAX and not self._end:
            return
        self._lines.append(line)
        while self._bytes > _LINES_BYTES_MAX:
            self._bytes -= _size(self._lines.popleft())

    def page(self) -> Page:
        """Return the page, after the last bytes."""
        if self._partial:
            self.feed(b"\n")
        kept = len(self._lines)
        before = self._count - kept if self._end else min(self._skip, self._count)
        return Page(tuple(self._lines), before, self._count - kept - before)


def page_of(lines: Iterable[str], skip: int = 0) -> Page:
    """Return a page of lines that are there already."""
    keeper = PageKeeper(skip=skip)
    for text in lines:
        for line in text.splitlines() or [""]:
            keeper.add(line)
    return keeper.page()


def answer(title: str, page: Page, then: Sequence[str], *, is_end: bool = False) -> str:
    """Return the text of an answer: a title, the marked lines, how to get more, what is next."""
    lines = [shortened(printable(title), _TITLE_MAX)]
    if page.before:
        lines.append(f"({page.before} lines before these)")
    lines += [f"{_MARK}{line}".rstrip() for line in page.lines]
    if page.after and not is_end:
        end = page.before + len(page.lines)
        lines.append(f"({page.after} more lines: skip={end} continues here; or ask for less)")
    lines += [f"next: {shortened(printable(one), _NEXT_MAX)}" for one in then[:_NEXT_COUNT]]
    return bounded("\n".join(lines))


def bounded(text: str) -> str:
    """Return a text, cut off at the bound of an answer."""
    data, most = text.encode("utf-8", "backslashreplace"), ANSWER_BYTES_MAX - _PREFIX_BYTES
    note = "\n(cut off here)"
    if len(data) > most:
        data = data[: most - len(note)]
        return data.decode("utf-8", "ignore") + note
    return data.decode()


def _size(line: str) -> int:
    return len(line.encode("utf-8", "backslashreplace")) + len(_MARK) + 1
