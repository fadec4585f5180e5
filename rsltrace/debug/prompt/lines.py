"""Lines of a debugging session: typed at a terminal, or out of a pipe or file."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from rsltrace.terminal import say

Completer = Callable[[str], Sequence[str]]
"""By a line up to where the cursor is: what its last word could become."""


class LineReader:
    """Gives ``first`` lines, then those of stdin. ``is_script``: nobody sits at a terminal."""

    def __init__(self, first: Sequence[str], complete: Completer) -> None:
        self._first = list(first)
        self._complete = complete
        self.is_script = sys.stdin is None or not sys.stdin.isatty()
        self._from_terminal = False

    @property
    def from_terminal(self) -> bool:
        """Whether the last line was typed."""
        return self._from_terminal

    def read(self, prompt: str) -> str | None:
        """Return the next line, None after the last one.

        :raises KeyboardInterrupt: Ctrl-C at the prompt.
        """
        self._from_terminal = False
        if self._first:
            line: str | None = self._first.pop(0)
        elif self.is_script:
            line = sys.stdin.readline() if sys.stdin is not None else ""
            line = line.rstrip("\n") if line else None
        else:
            self._from_terminal = True
            with _readline(self._complete):
                try:
                    return input(prompt)
                except EOFError:
                    say()
                    return None
        if line is not None:
            say(f"{prompt}{line}".rstrip())  # what is printed reads as if it had been typed
        return line


@contextmanager
def _readline(complete: Completer) -> Iterator[None]:
    """Let lines be edited, found again and completed, where Python has readline."""
    try:
        import readline
    except ImportError:
        yield
        return
    found: list[str] = []

    def completer(text: str, state: int) -> str | None:
        if state == 0:
            with suppress(Exception):  # a broken completion must not break the line
                found[:] = complete(readline.get_line_buffer()[: readline.get_endidx()])
        return found[state] if state < len(found) else None

    before = readline.get_completer(), readline.get_completer_delims()
    readline.set_completer(completer)
    readline.set_completer_delims(" \t")
    readline.parse_and_bind("tab: complete")
    try:
        yield
    finally:
        readline.set_completer(before[0])
        readline.set_completer_delims(before[1])
