"""The commands of the prompt, by the names that gdb, rr and pdb have for them."""

from __future__ import annotations

import json
import re
import select
import shlex
import socket
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from rsltrace.debug.checkpoints import StopReport
from rsltrace.debug.prompt import show
from rsltrace.errors import ConditionError, DebugError, did_you_mean, nearest
from rsltrace.terminal import say
from rsltrace.trace.words.entities import nodes_called

if TYPE_CHECKING:
    from rsltrace.checks.conditions.names import RunNames
    from rsltrace.debug.client import DebugSession


class PromptContext(Protocol):
    """What commands need of the prompt. A command that ends the session sets ``is_over``."""

    session: DebugSession
    is_over: bool

    def show(self, lines: Iterable[str]) -> None:
        """Print lines."""

    def stopped(self, stopped: StopReport) -> None:
        """Print where and why the run has stopped."""

    def read(self, prompt: str) -> str | None:
        """Return the next line for pdb; None at the end."""

    def node_here(self) -> str | None:
        """Return the node whose event is about to run, or has just ended."""

    def names(self) -> RunNames:
        """Return the names there are, as far as they are known."""


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


_LOOK_S = 0.1


def talk(start: Callable[[str], Any], read: Callable[[str], str | None]) -> Any:
    """Call ``start`` with the address at which we listen, serve ``pdb`` until it hangs up, and
    return what ``start`` returns (or raise what it raises).

    ``read`` gives the next line for a prompt, None if there are no more.
    """
    with _listening() as (listener, address):
        answer: list[Any] = []
        failure: list[BaseException] = []

        def call() -> None:
            try:
                answer.append(start(address))
            except BaseException as error:
                failure.append(error)

        thread = threading.Thread(target=call, name="pdb", daemon=True)
        thread.start()
        while thread.is_alive():
            if select.select([listener], [], [], _LOOK_S)[0]:
                connection, _ = listener.accept()
                with connection:
                    _serve(connection, read)
                break
        thread.join()
    if failure:
        raise failure[0]
    return answer[0]


@contextmanager
def _listening() -> Iterator[tuple[socket.socket, str]]:
    """Listen where only this user can connect."""
    with tempfile.TemporaryDirectory(prefix="rsltrace-pdb-") as folder:
        address = str(Path(folder, "socket"))
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(address)
            listener.listen(1)
            yield listener, address


def _serve(connection: socket.socket, read: Callable[[str], str | None]) -> None:
    """Show and read until the other side hangs up."""
    begun = ""
    with connection.makefile("rw", encoding="utf-8") as lines:
        for text in lines:
            message = json.loads(text)
            if "write" in message:
                whole, newline, begun = (begun + str(message["write"])).rpartition("\n")
                if newline:
                    say(whole)
            elif "read" in message:
                line = _line(begun, read)
                begun = ""
                lines.write(json.dumps({"line": line}) + "\n")
                lines.flush()
    if begun:
        say(begun)


def _line(prompt: str, read: Callable[[str], str | None]) -> str | None:
    while True:
        try:
            return read(prompt)
        except KeyboardInterrupt:
            say()


COMMANDS = PromptCommands()
_add = COMMANDS.add

_CHANGED = re.compile(r"(?P<node>[\w/~]+)(?:\.|\s+)(?P<attribute>\S.*)")


def _count(text: str, default: int = 1) -> int:
    if not text:
        return default
    if not (text.isascii() and text.isdecimal()):
        raise DebugError(f"{text!r} is no whole number")
    return int(text)


def _place(text: str) -> int | str:
    if not text:
        raise DebugError("where to? 812 is an event, 2.5s a time of the run")
    return int(text) if text.isascii() and text.isdecimal() else text.removeprefix("t=")


# -- running ---------------------------------------------------------------------------------------


@_add("step", "s", usage="[N]", topic="running", repeats=True)
def _step(shell: PromptContext, rest: str) -> None:
    """Run one event, or N."""
    shell.stopped(shell.session.step(_count(rest)))


@_add("next", "n", usage="[NODE]", topic="running", repeats=True)
def _next(shell: PromptContext, rest: str) -> None:
    """Run to the end of the next event of this node, or of NODE."""
    shell.stopped(shell.session.next(rest or None))


@_add("finish", "fin", topic="running", repeats=True)
def _finish(shell: PromptContext, rest: str) -> None:
    """Run to the end of this time step."""
    shell.stopped(shell.session.finish())


@_add("continue", "c", "cont", topic="running", repeats=True)
def _continue(shell: PromptContext, rest: str) -> None:
    """Run to the next breakpoint, or to the end.

    Ctrl-C stops the run after its present event.
    """
    shell.stopped(shell.session.go_on())


@_add("run-to", "until", "u", usage="PLACE", topic="running")
def _run_to(shell: PromptContext, rest: str) -> None:
    """Run to an event (812) or a time of the run (2.5s), or to a breakpoint before it.

    At 812, events 0 to 811 have ended. At 2.5s, all have that there are up to then.
    """
    shell.stopped(shell.session.run_to(_place(rest)))


# -- going back ------------------------------------------------------------------------------------


@_add("reverse-step", "rs", "back", usage="[N]", topic="going back", repeats=True)
def _reverse_step(shell: PromptContext, rest: str) -> None:
    """Go back one event, or N."""
    shell.stopped(shell.session.reverse_step(_count(rest)))


@_add("reverse-next", "rn", usage="[NODE]", topic="going back", repeats=True)
def _reverse_next(shell: PromptContext, rest: str) -> None:
    """Go back to the end of the event before, of this node or of NODE."""
    shell.stopped(shell.session.reverse_next(rest or None))


@_add("reverse-continue", "rc", topic="going back", repeats=True)
def _reverse_continue(shell: PromptContext, rest: str) -> None:
    """Go back to the previous place where a breakpoint stops, or to the beginning."""
    shell.stopped(shell.session.reverse_go_on())


@_add("goto", "g", usage="PLACE", topic="going back")
def _goto(shell: PromptContext, rest: str) -> None:
    """Go to the place before an event (812) or to a time (2.5s), ahead or back.

    No breakpoint stops. At 812, events 0 to 811 have ended. At 2.5s, all have that there are up to
    then.
    """
    shell.stopped(shell.session.go_to(_place(rest)))


# -- breakpoints -----------------------------------------------------------------------------------


@_add("break", "b", usage="CONDITION", topic="breakpoints")
def _break(shell: PromptContext, rest: str) -> None:
    """Set a breakpoint.

    812                           before event 812
    t=2.5s                        before the first event at that time of the run or later
    node /ekf, entity /scan       before an event of a node, of an entity (by name or #number)
    topic /odom                   before a callback receives a message, after one sends it
    /odom: pose.pose.position.x > 3    the same, of messages of which that is true
    output 3f2a                   after an event with an output of this hash
    exception [TYPE]              after an event that raised
    log [LEVEL] [/TEXT/]          after a log record of that level or worse
    finding [KIND]                after an event in which the guard found something
    watch ekf.P[0][0]             after an event that changes a value
    when node("ekf").P[0][0] > 1  after the event that makes it true
    All but the last two can end with 'if EXPRESSION'. Expressions are those of checks, not Python:
    fields, attributes of nodes, arithmetic, fixed functions.
    """
    if not rest:
        shell.show(show.breakpoint_lines(shell.session.breakpoints))
        return
    made = shell.session.break_at(rest)
    shell.show([f"breakpoint {made.number}: {made.text}"])


@_add("watch", usage="EXPRESSION", topic="breakpoints")
def _watch(shell: PromptContext, rest: str) -> None:
    """Stop after events that change a value: ekf.P[0][0], node("ekf").P."""
    _break(shell, f"watch {rest}")


@_add("delete", "d", usage="[NUMBER]...", topic="breakpoints")
def _delete(shell: PromptContext, rest: str) -> None:
    """Remove breakpoints, or all."""
    numbers = [_count(word) for word in rest.split()]
    for number in numbers or [one.number for one in shell.session.breakpoints]:
        shell.session.clear(number)


# -- looking ---------------------------------------------------------------------------------------

INFO = {
    "breakpoints": "the breakpoints",
    "nodes": "the nodes and their classes",
    "node": "[NODE]: the attributes and parameters of a node",
    "queues": "messages and requests that wait",
    "timers": "timers, and when they are due",
    "stacks": "callbacks that wait, and for what",
    "graph": "topics, services and actions with their ends",
    "message": "the input of the callback",
    "checkpoints": "copies of the run to go back to",
}


@_add("info", "i", usage="[WHAT]", topic="looking")
def _info(shell: PromptContext, rest: str) -> None:
    """Show breakpoints, nodes, queues, timers, stacks, graph, …; without WHAT, list these."""
    word, _, more = rest.partition(" ")
    if not word:
        shell.show(f"info {name:<12} {text}" for name, text in INFO.items())
        return
    found = [word] if word in INFO else [name for name in INFO if name.startswith(word)]
    if not found:
        hint = did_you_mean(word, INFO, f"there are {', '.join(INFO)}")
        raise DebugError(f"no info {word!r}; {hint}")
    what, session = found[0], shell.session
    if what == "breakpoints":
        shell.show(show.breakpoint_lines(session.breakpoints))
    elif what == "node":
        shell.show(show.value_lines(session.node(more.strip() or _node(shell))))
    elif what == "checkpoints":
        shell.show(show.checkpoint_lines(session.checkpoints()))
    elif what == "queues":
        shell.show(show.queue_lines(session.inspect(what)))
    elif what == "graph":
        shell.show(show.graph_lines(session.inspect(what)))
    else:
        value = session.inspect(what)
        nothing = ["this event has received no message"]
        shell.show(nothing if value is None else show.value_lines(value))


def _node(shell: PromptContext) -> str:
    name = shell.node_here()
    if name is None:
        raise DebugError("the current event belongs to no node: give a node")
    return name


@_add("print", "p", usage="EXPRESSION", topic="looking")
def _print(shell: PromptContext, rest: str) -> None:
    """Evaluate Python: attributes of this node, node("ekf"), fields of its message, msg, now.

    This is Python, methods of nodes included, in a copy of the run, so it changes nothing here.
    Conditions (break, watch, when) use the language of checks.
    """
    if not rest:
        raise DebugError('print what? P[0][0] of this node, node("ekf").P, msg, now, event')
    here = shell.node_here()
    there = [one["name"] for one in shell.session.inspect("nodes")]
    value = shell.session.evaluated(rest, here if here in there else None)
    shell.show(value.splitlines() or [""])


@_add("list", "l", topic="looking")
def _list(shell: PromptContext, rest: str) -> None:
    """Show the source lines of the callback."""
    shell.show(show.source_lines(shell.session.inspect("source")))


@_add("where", "w", "bt", topic="looking")
def _where(shell: PromptContext, rest: str) -> None:
    """Show the event here, its cause and its hashes."""
    shell.show(show.where_lines(shell.session.position))


@_add("pdb", topic="looking")
def _pdb(shell: PromptContext, rest: str) -> None:
    """Call the next callback under pdb, from its first line on.

    It runs in a copy, so nothing changes here. "c" or "q" of pdb returns to this prompt, before
    the callback; "step" runs it.
    """
    raised = talk(shell.session.pdb, shell.read)
    if raised:
        shell.show([f"the callback raised {raised}"])
    shell.show([show.position_line(shell.session.position)])


@_add("gdb", usage="[NODE]", topic="looking")
def _gdb(shell: PromptContext, rest: str) -> None:
    """Show the command that attaches gdb to the C or C++ process of a node, for another terminal.

    It stops in the next callback: "step" here runs that, and waits while gdb holds the process.
    Going back starts the process anew: attach again.
    """
    node = rest or shell.node_here()
    found = shell.session.inspect("processes")
    if node is not None:
        found = [one for one in found if nodes_called(node, one["nodes"])]
    if len(found) != 1:
        raise DebugError(f"no C or C++ process runs {node}" if node else "of which node? gdb NODE")
    breaks = [word for line in found[0]["callbacks"] for word in ("-ex", f"break {line}")]
    shell.show([shlex.join(["gdb", "-p", str(found[0]["pid"]), *breaks, "-ex", "continue"])])


@_add("debugpy", usage="[PORT]", topic="looking")
def _debugpy(shell: PromptContext, rest: str) -> None:
    """Continue in a copy of the run under debugpy, for an editor (VS Code): port 5678.

    The editor stops in the first line of the next callback, and at its breakpoints; simulated time
    stands still meanwhile. When it disconnects, or with Ctrl-C, this prompt returns; the run has
    not moved.
    """
    shell.show([shell.session.debugpy(_count(rest, 5678))])
    shell.show([show.position_line(shell.session.position)])


# -- searching -------------------------------------------------------------------------------------


@_add("who-changed", "wc", usage="NODE ATTRIBUTE", topic="searching")
def _who_changed(shell: PromptContext, rest: str) -> None:
    """Find the last event up to here that changed an attribute: who-changed ekf P[0][0]."""
    found = _CHANGED.fullmatch(rest)
    if found is None:
        raise DebugError("give a node and an attribute: who-changed ekf P[0][0]")
    shell.show(show.found_lines(shell.session.last_changed(found["node"], found["attribute"])))


@_add("who-sent", "ws", usage="[EVENT]", topic="searching")
def _who_sent(shell: PromptContext, rest: str) -> None:
    """Find the event that sent the input of this one, or of EVENT."""
    position = shell.session.position
    index = _count(rest, position.index if position.is_next else position.index - 1)
    if index < 0:
        raise DebugError("nothing has run yet")
    shell.show(show.found_lines(shell.session.sent_by(index)))


@_add("when", usage="CONDITION", topic="searching")
def _when(shell: PromptContext, rest: str) -> None:
    """Find the first event up to here at which a condition (see break) is true.

    An expression alone is one, too: when ekf.P[0][0] > 1.
    """
    if not rest:
        raise ConditionError("when what? A condition, as of a breakpoint", "when ", 5)
    shell.show(show.found_lines(shell.session.first_true(_as_condition(rest, shell))))


def _as_condition(text: str, shell: PromptContext) -> str:
    """Return the condition that a text means: an expression is ``when …``."""
    from rsltrace.checks.conditions.expressions import parse_expression
    from rsltrace.checks.conditions.text import parse_condition

    try:
        parse_condition(text, shell.names())
    except ConditionError:
        try:
            parse_expression(text, shell.names())
        except ConditionError:
            return text
        return f"when {text}"
    return text


# -- what if ---------------------------------------------------------------------------------------


@_add("edit", usage="EDIT", topic="what if")
def _edit(shell: PromptContext, rest: str) -> None:
    """Change something here, and continue in a branch of the run.

    message.data = 3.0                the message that the next event receives
    topic("/odom").x += 1             the next message on a topic
    node("/ekf").P[0][0] = 1e-3       an attribute
    parameters("/ekf")["rate"] = 20   a parameter
    drop()  delay("5ms")  defer()     the next event: leave out, delay, run after the others
    812: drop()                       the same at event 812, or at a time (2.5s: ...)
    """
    position = shell.session.edit(rest)
    shell.stopped(StopReport("step", position))


@_add("keep", usage="FILE", topic="what if")
def _keep(shell: PromptContext, rest: str) -> None:
    """Write the trace of the current branch to FILE."""
    if not rest:
        raise DebugError("give a file: keep branch.mcap")
    shell.show([f"wrote {shell.session.branch(rest)}"])


# -- the rest --------------------------------------------------------------------------------------


@_add("help", "h", "?", usage="[COMMAND]", topic="the rest")
def _help(shell: PromptContext, rest: str) -> None:
    """Show this list, or the help of COMMAND."""
    shell.show(COMMANDS.help(rest))


@_add("quit", "q", "exit", topic="the rest")
def _quit(shell: PromptContext, rest: str) -> None:
    """End the session."""
    shell.is_over = True
