"""What a line at the prompt could become."""

from __future__ import annotations

from collections.abc import Iterable

from rsltrace.conditions.names import short_name
from rsltrace.debug.prompt.command_table import COMMANDS, INFO
from rsltrace.debug.prompt.commands import Prompt
from rsltrace.errors import DebugError
from rsltrace.trace.model.finding import Source
from rsltrace.trace.words.matching import LOG_LEVELS

_HEADS = "node topic entity output exception log finding watch when t=".split()


def completions(text: str, shell: Prompt) -> list[str]:
    """Return what the last word of ``text`` could become."""
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


def _arguments(command: str, before: list[str], shell: Prompt) -> Iterable[str]:
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
            "finding": tuple(source.value for source in Source),
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


def _nodes_as_names(shell: Prompt) -> tuple[str, ...]:
    return tuple(f"{short_name(node)}." for node in shell.names().nodes)


def _begin(words: Iterable[str], with_: str) -> list[str]:
    return sorted({word for word in words if word.startswith(with_)})
