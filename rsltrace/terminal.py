"""The one place that writes to the terminal: what could steer it is shown as escapes.

Texts come from traces, bags, jobs, servers and nodes, which may be anybody's. An escape sequence in
a name must not set a window's title, hide a line or turn text around. Lines stay lines.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable

from rsltrace.trace.model.texts import printable, printable_lines


def say(text: str = "", *, end: str = "\n") -> None:
    """Write an answer to stdout. Raises OSError if it cannot be written."""
    if sys.stdout is not None:
        sys.stdout.write(printable_lines(f"{text}{end}"))
        sys.stdout.flush()


def tell(text: str, *, end: str = "\n") -> None:
    """Write what is not the answer (errors, notes, progress) to stderr."""
    if sys.stderr is not None:
        sys.stderr.write(_broken_at_words(printable_lines(f"{text}{end}")))
        sys.stderr.flush()


def _broken_at_words(text: str) -> str:
    """Break the first line of a note or an error at words if it goes to a terminal, which breaks
    lines anywhere. Other lines stay: they are commands to be copied, or columns."""
    first, *others = text.split("\n", 1)
    if not first.startswith("rsltrace: ") or not sys.stderr.isatty():
        return text
    import os
    import textwrap

    width = os.get_terminal_size(sys.stderr.fileno()).columns or 80
    words = textwrap.fill(first, width, break_long_words=False, break_on_hyphens=False)
    return "\n".join([words, *others])


def tell_notes(notes: Iterable[str]) -> None:
    """Write what there is to know about an answer to stderr, each note in a line."""
    for note in notes:
        tell(printable(f"rsltrace: note: {note}"))


def terminal_width() -> int | None:
    """Return how many columns the terminal has that answers go to, None if they go elsewhere."""
    if not sys.stdout.isatty():
        return None
    import shutil  # not everyone looks at a terminal

    return shutil.get_terminal_size().columns


def line_writer() -> Callable[[str], object]:
    """Return what writes a line of many to stdout, without pushing each of them through."""
    write = sys.stdout.write
    return lambda line: write(printable_lines(f"{line}\n"))
