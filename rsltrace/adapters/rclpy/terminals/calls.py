"""Calls that read from a terminal: ``input``, ``os.read``, ``select``; and whose terminal is
descriptor 0."""

from __future__ import annotations

import builtins
import os
import select
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from rsltrace.adapters.rclpy.stacks.blocking_calls import wait
from rsltrace.adapters.rclpy.stacks.program import Program
from rsltrace.adapters.rclpy.stacks.simulated_sleep import simulated_stacks
from rsltrace.adapters.rclpy.stacks.stacks import Stacks
from rsltrace.adapters.rclpy.terminals.curses_keys import simulated_curses
from rsltrace.adapters.rclpy.terminals.no_terminal import NoTerminal, refuse
from rsltrace.adapters.rclpy.terminals.terminal import Terminal
from rsltrace.guard.redirect import copy_of, redirect
from rsltrace.trace.model.stamp import patience_ns

_STEP_NS = 1_000_000
_dup = copy_of(os.dup)  # type: ignore[arg-type]
_dup2 = copy_of(os.dup2)  # type: ignore[arg-type]
_close = copy_of(os.close)  # type: ignore[arg-type]


class Terminals:
    """The terminals of a run's mains. While a main runs, its terminal is descriptor 0 (and 1, for
    curses)."""

    def __init__(self, stacks: Stacks) -> None:
        self._stacks = stacks
        self._stdin = sys.stdin
        self._real: dict[int, int] = {}
        self._at: dict[int, Terminal | None] = {}
        self._all: dict[Program, Terminal] = {}
        stacks.programs.stdin_of = self.stdin_of

    @property
    def present(self) -> Terminal | None:
        """The terminal of the main that runs, if it has one."""
        return self._all.get(self._stacks.programs.present)

    def make(self, programs: Sequence[Program], start_ns: int) -> None:
        """Give mains their terminals; the times of what is typed count from ``start_ns``."""
        for program in programs:
            assert program.entry is not None
            if program.entry.stdin is not None:
                self._all[program] = Terminal(self._stacks, program.entry.stdin, start_ns)
                self._stacks.programs.on_enter = self._enter

    def hand_over(self, program: Program, successor: Program) -> None:
        """Let a main that is started again have the terminal of the one before."""
        if program in self._all:
            self._all[successor] = self._all[program]

    def stdin_of(self, program: Program) -> Any:
        """Return the ``sys.stdin`` of a main."""
        terminal = self._all.get(program)
        return NoTerminal(self._stdin) if terminal is None else terminal.stream

    def show(self, terminal: Terminal, has_screen: bool) -> None:
        """Let what the main that runs prints go to its terminal, or no longer."""
        terminal.has_screen = has_screen
        self._enter(self._stacks.programs.present)

    def _enter(self, program: Program) -> None:
        terminal = self._all.get(program)
        self._put(0, terminal)
        self._put(1, terminal if terminal is not None and terminal.has_screen else None)

    def _put(self, number: int, terminal: Terminal | None) -> None:
        """Make a terminal, or what was there before the run, a standard stream of the process."""
        if terminal is self._at.get(number):
            return
        if number not in self._real:
            try:
                self._real[number] = _dup(number)
            except OSError:  # rsltrace itself has none
                self._real[number] = os.open(os.devnull, os.O_RDWR)
        if number:
            with suppress(Exception):
                sys.stdout.flush()
        _dup2(self._real[number] if terminal is None else terminal.fd, number)
        self._at[number] = terminal

    def close(self) -> None:
        """Put the standard streams back and close all terminals."""
        self._put(0, None)
        self._put(1, None)
        for copy in self._real.values():
            _close(copy)
        for terminal in self._all.values():
            with suppress(OSError):
                terminal.close()
        self._all.clear()


@contextmanager
def simulated_terminals(stacks: Stacks) -> Iterator[Terminals]:
    """Let mains read from terminals of their own, and nobody from that of rsltrace."""
    terminals = Terminals(stacks)
    real_stdin = sys.stdin
    with ExitStack() as stack:
        stack.callback(setattr, sys, "stdin", real_stdin)
        sys.stdin = NoTerminal(real_stdin)
        stack.callback(terminals.close)
        redirect(stack, builtins.input, _inputs)
        redirect(stack, os.read, lambda real: _reads(terminals, real))
        redirect(stack, select.select, lambda real: _selects(terminals, real))
        stack.enter_context(simulated_curses(lambda: _asking(terminals), terminals.show))
        yield terminals


def _asking(terminals: Terminals) -> Terminal | None:
    """Return the terminal of whoever asks, if it is a main's code that does."""
    stacks = simulated_stacks()
    return None if stacks is None or stacks.event.handle is None else terminals.present


def _inputs(real: Callable[..., str]) -> Callable[..., str]:
    def input_(prompt: object = "", /) -> str:
        stacks = simulated_stacks()
        if stacks is None or stacks.event.handle is None:
            return real(prompt)
        if isinstance(sys.stdin, NoTerminal):
            refuse("input()")
            return real(prompt)
        shown_on = sys.stdout  # the node's own words, as all that it prints
        shown_on.write(str(prompt))
        shown_on.flush()
        line = sys.stdin.readline()
        if not line:
            raise EOFError
        return line.removesuffix("\n")

    return input_


def _reads(terminals: Terminals, real: Callable[[int, int], bytes]) -> Callable[..., bytes]:
    def read(fd: int, size: int, /) -> bytes:
        if fd == 0:
            terminal = _asking(terminals)
            if terminal is not None:
                return terminal.read(size)
            refuse("os.read(0)")
        return real(fd, size)

    return read


def _selects(terminals: Terminals, real: Callable[..., Any]) -> Callable[..., Any]:
    def ready(
        reads: Any, writes: Any, others: Any, timeout: float | None = None, /
    ) -> tuple[list[Any], list[Any], list[Any]]:
        terminal = _asking(terminals)
        waited_for = list(reads) if terminal is not None else []
        if terminal is None or not any(_is_stdin(one) for one in waited_for):
            return real(reads, writes, others, timeout)  # type: ignore[no-any-return]
        kinds = [waited_for, list(writes), list(others)]
        alone = sum(map(len, kinds)) == 1
        stacks = terminals._stacks
        until_ns = None if timeout is None else stacks.loop.now_ns + patience_ns(timeout)
        while True:
            terminal.offer()
            found = real(*kinds, 0)
            left_ns = None if until_ns is None else until_ns - stacks.loop.now_ns
            if any(found):
                return found  # type: ignore[no-any-return]
            if left_ns is not None and left_ns <= 0:
                if timeout == 0 and terminal.look():
                    return real(*kinds, 0)  # type: ignore[no-any-return]
                return found  # type: ignore[no-any-return]
            if alone:
                terminal.await_input(left_ns)
            else:
                step_ns = _STEP_NS if left_ns is None else min(left_ns, _STEP_NS)
                wait(stacks, "one of several descriptors", for_ns=step_ns, quiet=True)

    return ready


def _is_stdin(thing: Any) -> bool:
    if isinstance(thing, int):
        return thing == 0
    fileno = getattr(thing, "fileno", None)
    return fileno is not None and fileno() == 0
