"""The prompt: reads commands, sends them to the session, and prints the answers.

It uses nothing but the session's public API.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from rsltrace.checks.conditions.names import RunNames
from rsltrace.debug.prompt import show
from rsltrace.debug.prompt.command_table import COMMANDS, INFO, PromptContext
from rsltrace.errors import DebugError, RsltraceError
from rsltrace.terminal import say, tell
from rsltrace.trace.model.finding import NondeterminismSource
from rsltrace.trace.words.entities import LOG_LEVELS, short_name

if TYPE_CHECKING:
    from rsltrace.debug.checkpoints import StopReport
    from rsltrace.debug.client import DebugSession

Completer = Callable[[str], Sequence[str]]
"""By a line up to where the cursor is: what its last word could become."""


class LineReader:
    """Reads ``first``, then stdin. ``is_script``: stdin is not a terminal."""

    def __init__(self, first: Sequence[str], complete: Completer) -> None:
        self.unread = list(first)
        """Those of ``first`` that have not been read."""
        self._complete = complete
        self.is_script = sys.stdin is None or not sys.stdin.isatty()
        self._from_terminal = False

    @property
    def from_terminal(self) -> bool:
        return self._from_terminal

    def read(self, prompt: str) -> str | None:
        """Return the next line, None after the last one.

        :raises KeyboardInterrupt: Ctrl-C at the prompt.
        """
        self._from_terminal = False
        if self.unread:
            line: str | None = self.unread.pop(0)
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
    """Enable editing, history and completion, where Python has readline."""
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


_HEADS = "node topic entity output exception log finding watch when t=".split()


def completions(text: str, shell: PromptContext) -> list[str]:
    """Return the completions of the last word of ``text``."""
    words = text.lstrip().split(" ")
    last = words[-1]
    if len(words) == 1:
        found = _begin((command.name for command in COMMANDS.all), last)
        return [f"{found[0]} "] if len(found) == 1 else found
    try:
        name = COMMANDS.find(words[0]).name
    except DebugError:
        return []
    return _begin(_arguments(name, words[1:-1], shell), last)


def _arguments(command: str, before: list[str], shell: PromptContext) -> Iterable[str]:
    names = shell.names()
    if command in ("break", "when") and not before:
        messages = (f"{topic}:" for topic in names.topics)
        return (*_HEADS, *names.nodes, *messages, *names.entities)
    if command in ("break", "when"):
        of = {
            "node": names.nodes,
            "topic": names.topics,
            "entity": names.entities,
            "log": tuple(LOG_LEVELS),
            "finding": tuple(source.value for source in NondeterminismSource),
        }
        return of.get(before[0], _nodes_as_names(shell))
    if command == "info":
        return names.nodes if before[:1] == ["node"] else tuple(INFO)
    if command in ("next", "reverse-next", "who-changed") and not before:
        return (*names.nodes, *map(short_name, names.nodes))
    if command == "who-changed" and len(before) == 1:
        return shell.session.node(before[0])
    if command in ("print", "watch"):
        here = shell.node_here()
        own = () if here is None else tuple(shell.session.node(here))
        return (*own, *_nodes_as_names(shell), *(f'node("{name}")' for name in names.nodes))
    if command == "help":
        return (one.name for one in COMMANDS.all)
    if command == "delete":
        return (str(one.number) for one in shell.session.breakpoints)
    return ()


def _nodes_as_names(shell: PromptContext) -> tuple[str, ...]:
    return tuple(f"{short_name(node)}." for node in shell.names().nodes)


def _begin(words: Iterable[str], with_: str) -> list[str]:
    return sorted({word for word in words if word.startswith(with_)})


PROMPT = "(rsltrace) "
EXIT_DIVERGED = 1


class DebugPrompt:
    """The prompt of one session. ``diverged``: the run once differed from its trace."""

    def __init__(
        self, session: DebugSession, first: Sequence[str] = (), names: RunNames | None = None
    ) -> None:
        """``first`` are commands to run before those of stdin; ``names`` are the trace's."""
        self.session = session
        self.diverged = False
        self.is_over = False
        self._names = names
        self._lines = LineReader(first, lambda text: completions(text, self))
        self._last = ""

    def run(self) -> int:
        """Run commands until the end of input; return the exit status. A script ends at the first
        command that fails."""
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
                    if self._lines.unread:
                        tell(f"not run: {'; '.join(self._lines.unread)}")
                    return error.exit_code
        return EXIT_DIVERGED if self.diverged else 0

    def carry_out(self, line: str) -> None:
        """Run one command line.

        :raises RsltraceError: it failed.
        """
        text = line.strip()
        if not text and self._lines.from_terminal:
            text = self._last
        self._last = ""
        if not text or text.startswith("#"):
            return
        word, _, rest = text.partition(" ")
        if "/" in word and not word.startswith("/"):  # print/x of gdb
            raise DebugError(f"{word!r}: there are no formats; use Python: hex(…)")
        command = COMMANDS.find(word)
        with self._interruptible():
            command.run(self, rest.strip())
        if command.repeats:
            self._last = text

    def show(self, lines: Iterable[str]) -> None:
        for line in lines:
            say(line)

    def stopped(self, stopped: StopReport) -> None:
        self.diverged = self.diverged or stopped.reason == "diverged"
        self.show(show.stopped_lines(stopped))

    def read(self, prompt: str) -> str | None:
        return self._lines.read(prompt)

    def node_here(self) -> str | None:
        position = self.session.position
        event = position.next if position.is_next else position.event
        name = (event or {}).get("node")
        return str(name) if name else None

    def names(self) -> RunNames:
        if self._names is not None:
            return self._names
        graph: dict[str, Any] = self.session.inspect("graph")
        links = graph.get("links", ())
        nodes = tuple(node["name"] for node in self.session.inspect("nodes"))
        topics = tuple(link["name"] for link in links if link["kind"] in ("topic", "service"))
        return RunNames(nodes=nodes, topics=topics, entities=(*nodes, *topics))

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Let Ctrl-C pause the run, after its current event, instead of ending the session."""

        def interrupt(number: int, frame: object) -> None:
            self.session.pause()

        before = signal.signal(signal.SIGINT, interrupt)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)
