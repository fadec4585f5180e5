"""The prompt: reads commands, has the session carry them out, prints what came of it.

It knows nothing of the run but what the session says, as any client of it.
"""

from __future__ import annotations

import signal
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rsltrace.conditions.names import Names
from rsltrace.debug.prompt import show
from rsltrace.debug.prompt.command_table import COMMANDS
from rsltrace.debug.prompt.completion import completions
from rsltrace.debug.prompt.lines import LineReader
from rsltrace.errors import DebugError, RsltraceError
from rsltrace.terminal import say, tell

if TYPE_CHECKING:
    from rsltrace.debug.client import DebugSession
    from rsltrace.debug.positions import Stopped

PROMPT = "(rsltrace) "
EXIT_DIVERGED = 1


class Shell:
    """A conversation about one session.

    ``diverged`` says whether the run has once done something else than its trace says.
    """

    def __init__(
        self, session: DebugSession, first: Sequence[str] = (), names: Names | None = None
    ) -> None:
        """``first`` are commands before those of stdin, ``names`` those of the trace, if any."""
        self.session = session
        self.diverged = False
        self.is_over = False
        self._names = names
        self._lines = LineReader(first, lambda text: completions(text, self))
        self._last = ""

    def run(self) -> int:
        """Carry out commands until there are no more; return the exit status.

        In a script, a command that cannot be carried out ends it: the next ones count on it.
        """
        self.show([show.position_line(self.session.position)])
        while not self.is_over:
            try:
                line = self._lines.read(PROMPT)
            except KeyboardInterrupt:
                say()
                continue
            if line is None:
                break
            try:
                self.carry_out(line)
            except RsltraceError as error:
                tell(f"error: {error}")
                if self._lines.is_script:
                    return error.exit_code
        return EXIT_DIVERGED if self.diverged else 0

    def carry_out(self, line: str) -> None:
        """Do what a line says.

        :raises RsltraceError: it cannot be done.
        """
        text = line.strip()
        if not text and self._lines.from_terminal:
            text = self._last
        self._last = ""
        if not text or text.startswith("#"):
            return
        word, _, rest = text.partition(" ")
        if "/" in word and not word.startswith("/"):  # print/x of gdb
            raise DebugError(f"{word!r}: there are no formats; say it in Python: hex(…)")
        command = COMMANDS.find(word)
        with self._interruptible():
            command.run(self, rest.strip())
        if command.repeats:
            self._last = text

    # -- for commands ------------------------------------------------------------------------------

    def show(self, lines: Iterable[str]) -> None:
        """Print lines."""
        for line in lines:
            say(line)

    def stopped(self, stopped: Stopped) -> None:
        """Print where and why the run has stopped."""
        self.diverged = self.diverged or stopped.reason == "diverged"
        self.show(show.stopped_lines(stopped))

    def read(self, prompt: str) -> str | None:
        """Return the next line, for somebody else; None if there are no more."""
        return self._lines.read(prompt)

    def node_here(self) -> str | None:
        """Return the node whose event is about to run, or has just ended."""
        position = self.session.position
        event = position.next if position.is_next else position.event
        name = (event or {}).get("node")
        return str(name) if name else None

    def names(self) -> Names:
        """Return the names there are, as far as they are known."""
        if self._names is not None:
            return self._names
        graph: dict[str, Any] = self.session.inspect("graph")
        links = graph.get("links", ())
        nodes = tuple(node["name"] for node in self.session.inspect("nodes"))
        topics = tuple(link["name"] for link in links if link["kind"] in ("topic", "service"))
        return Names(nodes=nodes, topics=topics, entities=(*nodes, *topics))

    # -- Ctrl-C ------------------------------------------------------------------------------------

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Let Ctrl-C stop the run under way, after its present event, and not the session."""

        def interrupt(number: int, frame: object) -> None:
            self.session.pause()

        before = signal.signal(signal.SIGINT, interrupt)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)
