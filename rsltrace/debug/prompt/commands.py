"""The command registry of the prompt: names, abbreviations, help."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from inspect import cleandoc
from typing import TYPE_CHECKING, Any

from rsltrace.errors import DebugError, nearest

if TYPE_CHECKING:
    pass


Run = Callable[[Any, str], object]
"""What a command does, given the prompt and what follows its name."""


@dataclass(frozen=True, slots=True)
class PromptCommand:
    """A command: its names (the first is its own), what follows them, and what it does.

    An empty line ``repeats`` it. ``topic`` is the group that help lists it in.
    """

    names: tuple[str, ...]
    usage: str
    help: str
    run: Run
    topic: str
    repeats: bool = False

    @property
    def name(self) -> str:
        return self.names[0]


class PromptCommands:
    def __init__(self) -> None:
        self.all: list[PromptCommand] = []
        self._by_name: dict[str, PromptCommand] = {}

    def add(
        self, *names: str, topic: str, usage: str = "", repeats: bool = False
    ) -> Callable[[Run], Run]:
        """Make a function a command; its docstring is the help."""

        def added(run: Run) -> Run:
            command = PromptCommand(names, usage, cleandoc(run.__doc__ or ""), run, topic, repeats)
            assert not self._by_name.keys() & names, "one name, one command"
            self.all.append(command)
            self._by_name.update(dict.fromkeys(names, command))
            return run

        return added

    def find(self, word: str) -> PromptCommand:
        """Return the command of a name, or of the unique beginning of one.

        :raises DebugError: none or several match.
        """
        found = self._by_name.get(word)
        if found is not None:
            return found
        begins = {c.name: c for name, c in self._by_name.items() if name.startswith(word)}
        if len(begins) == 1:
            return next(iter(begins.values()))
        if begins:
            raise DebugError(f"{word!r} could be {', '.join(sorted(begins))}")
        near = nearest(word, self._by_name)
        hint = f"did you mean {near!r}?" if near else "'help' lists what there is"
        raise DebugError(f"there is no command {word!r}; {hint}")

    def help(self, word: str = "") -> Iterator[str]:
        """Yield the help of one command, or the list of all.

        :raises DebugError: there is no such command.
        """
        if word:
            command = self.find(word)
            yield f"{' | '.join(command.names)} {command.usage}".rstrip()
            yield from (f"  {line}".rstrip() for line in command.help.splitlines())
            return
        width = max(len(f"{c.name} {c.usage}") for c in self.all)
        for topic in dict.fromkeys(command.topic for command in self.all):
            yield f"{topic}:"
            for command in self.all:
                if command.topic == topic:
                    said = f"{command.name} {command.usage}".rstrip()
                    short = next((n for n in command.names[1:] if len(n) < 4), "")
                    first = command.help.splitlines()[0]
                    yield f"  {short:<4} {said:<{width}}  {first}"
        yield "Commands can be abbreviated; 'help COMMAND' says more. An empty line repeats a step."
