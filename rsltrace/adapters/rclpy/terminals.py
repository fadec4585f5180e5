"""A main's terminal: a pseudo-terminal of the system, with input from the job.

The system's line discipline works as natively (lines, raw keys, ``termios``). Only the time is
simulated: keys are typed at their time when the main reads, so that no flush loses them, and
reading waits in simulated time.
"""

from __future__ import annotations

import builtins
import fcntl
import io
import os
import select
import struct
import sys
import termios
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from types import FrameType
from typing import Any, NoReturn

from rsltrace.adapters.rclpy.concurrency.blocking_calls import POLL_NS, calling_runtime, wait
from rsltrace.adapters.rclpy.concurrency.program import SimulatedProgram
from rsltrace.adapters.rclpy.concurrency.runtime import BlockedCall, Runtime
from rsltrace.adapters.rclpy.entry import TypedInput
from rsltrace.errors import UnsupportedError
from rsltrace.guard.frames import replace_member
from rsltrace.guard.loading import when_loaded
from rsltrace.guard.redirect import copy_of, redirect
from rsltrace.trace.model.texts import waiting_ns

_END = b"\x04"
_LOCAL_MODES = 3
_SIZE = (24, 80)
"""Lines and columns."""
_openpty = copy_of(os.openpty)
_read = copy_of(os.read)
_write = copy_of(os.write)
_close = copy_of(os.close)
_poll = copy_of(select.poll)
_tcgetattr = copy_of(termios.tcgetattr)
_get_blocking = copy_of(os.get_blocking)


class Terminal:
    """``fd`` is the end that the main reads, ``stream`` its ``sys.stdin``. With ``has_screen`` the
    main also prints there (curses)."""

    def __init__(self, runtime: Runtime, typed: Sequence[TypedInput], start_ns: int) -> None:
        self._runtime = runtime
        self._typed = deque(typed)
        self._start_ns = start_ns
        self._keyboard, self.fd = map(_above_standard, _openpty())
        os.set_blocking(self._keyboard, False)
        fcntl.ioctl(self.fd, termios.TIOCSWINSZ, struct.pack("HHHH", *_SIZE, 0, 0))
        self.has_screen = False
        self._waiting: list[BlockedCall] = []
        self._at_end = False
        self._looked_ns = -1
        self.stream = io.TextIOWrapper(io.BufferedReader(_Input(self)), encoding="utf-8")
        for at_ns in {at_ns for at_ns, _ in typed if at_ns is not None}:
            runtime.loop.schedule(start_ns + at_ns, self._wake)

    def close(self) -> None:
        """Close both ends."""
        for fd in (self._keyboard, self.fd):
            _close(fd)

    def _wake(self) -> None:
        waits, self._waiting = self._waiting, []
        for blocked in waits:
            blocked.release()

    # -- typing ------------------------------------------------------------------------------------

    def offer(self) -> bool:
        """Type what is due unless there is unread input; return whether there is input."""
        while not self._is_readable():
            if not self._typed or not self._is_due(self._typed[0][0]):
                return False
            keys = self._typed.popleft()[1]
            if keys is not None:
                self._type(keys)
            elif self._takes_lines():
                self._type(_END)
            self._at_end = keys is None
        return True

    def _is_due(self, at_ns: int | None) -> bool:
        return at_ns is None or self._start_ns + at_ns <= self._runtime.loop.now_ns

    def _type(self, keys: bytes) -> None:
        _write(self._keyboard, keys)
        self.drain()

    def drain(self) -> None:
        """Discard what it shows."""
        with suppress(BlockingIOError):
            while _read(self._keyboard, 65536):
                pass

    def _is_readable(self) -> bool:
        poll = _poll()
        poll.register(self.fd, select.POLLIN)
        return bool(poll.poll(0))

    def _takes_lines(self) -> bool:
        return bool(_tcgetattr(self.fd)[_LOCAL_MODES] & termios.ICANON)

    # -- reading -----------------------------------------------------------------------------------

    def await_input(self, for_ns: int | None = None) -> bool:
        """Wait in simulated time for input; return whether there is any."""
        runtime = self._runtime
        until_ns = None if for_ns is None else runtime.loop.now_ns + for_ns
        while not self.offer():
            left_ns = None if until_ns is None else until_ns - runtime.loop.now_ns
            if left_ns is not None and left_ns <= 0:
                return False
            if self._at_end and not self._typed and self._takes_lines():
                wait(runtime, "the end of its input", for_ns=POLL_NS, quiet=True)
                self._type(_END)  # every further read gets the end, too
                continue
            wait(
                runtime,
                "something to be typed (stdin)",
                until=self._waiting.append,
                for_ns=left_ns,
                patient=True,
            )
            self._waiting = [blocked for blocked in self._waiting if blocked.waiting]
        return True

    def look(self) -> bool:
        """Return whether there is input. A second look at one instant takes a millisecond."""
        loop = self._runtime.loop
        if self.offer():
            return True
        again, self._looked_ns = self._looked_ns == loop.now_ns, loop.now_ns
        return again and self.await_input(POLL_NS)

    def read(self, size: int) -> bytes:
        """Read the input, as ``os.read`` does.

        :raises BlockingIOError: there is none, and the main has made it non-blocking.
        """
        if _get_blocking(self.fd):
            self.await_input()
        else:
            self.offer()
        found: bytes = _read(self.fd, size)
        return found


def _above_standard(fd: int) -> int:
    """Return a descriptor above the standard streams, which rsltrace may have closed."""
    if fd > 2:
        return fd
    moved: int = fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, 3)
    _close(fd)
    return moved


class _Input(io.RawIOBase):
    """The raw stream of ``sys.stdin``: in a main, the terminal is descriptor 0."""

    name = "<stdin>"
    mode = "rb"

    def __init__(self, terminal: Terminal) -> None:
        self._terminal = terminal

    def fileno(self) -> int:
        return 0

    def isatty(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int | None:
        view = memoryview(buffer).cast("B")
        try:
            data = self._terminal.read(len(view))
        except BlockingIOError:
            return None
        view[: len(data)] = data
        return len(data)


# Replaces calls that read from a terminal: ``input``, ``os.read``, ``select``, curses.

_DEBUGGERS = ("bdb", "cmd", "code", "pdb", "IPython", "prompt_toolkit", "debugpy", "pydevd")


class NoTerminal:
    """The ``sys.stdin`` of nodes without a terminal: reading is an error, except for debuggers and
    code outside of nodes, which read the real stream."""

    def __init__(self, real: Any) -> None:
        self._real = real

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    @property
    def buffer(self) -> NoTerminal:
        return NoTerminal(self._real.buffer)

    def read(self, *arguments: Any) -> Any:
        """Read all, or so much."""
        refuse_reading("sys.stdin.read()")
        return self._real.read(*arguments)

    def readline(self, *arguments: Any) -> Any:
        refuse_reading("sys.stdin.readline()")
        return self._real.readline(*arguments)

    def readlines(self, *arguments: Any) -> Any:
        refuse_reading("sys.stdin.readlines()")
        return self._real.readlines(*arguments)

    def __iter__(self) -> Iterator[Any]:
        refuse_reading("for line in sys.stdin")
        return iter(self._real)

    def __next__(self) -> Any:
        refuse_reading("next(sys.stdin)")
        return next(self._real)


def refuse_reading(call: str) -> None:
    """Raise ``UnsupportedError`` if a node's code reads, but no debugger."""
    runtime = calling_runtime()
    if runtime is None or runtime.event.handle is None or _is_debugged(sys._getframe(2)):
        return
    _fail(runtime, call)


def _fail(runtime: Runtime, call: str) -> NoReturn:
    program = runtime.programs.present
    if program.entry is None:
        raise UnsupportedError(
            f"{call}: a 'node' of a job has no terminal: write a function that spins it (main:), "
            "and give that entry its input: stdin: [...]"
        )
    raise UnsupportedError(
        f"{call}: {program.label} reads from its terminal, but its entry has no stdin: give it a "
        "file or a list, such as stdin: [yes, {at: 2s, keys: q}]"
    )


def _is_debugged(frame: FrameType | None) -> bool:
    while frame is not None:
        if str(frame.f_globals.get("__name__", "")).partition(".")[0] in _DEBUGGERS:
            return True
        frame = frame.f_back
    return False


_READS = ("getch", "getkey", "get_wch", "getstr")
_NS_PER_MS = 1_000_000
_FOR_EVER = -1
_NO_KEY = -1

TerminalOfCaller = Callable[[], "Terminal | None"]
"""Returns the terminal of the main whose code runs."""


ShowTerminal = Callable[[Terminal, bool], None]
"""Makes a terminal the main's standard output (True), or not (False)."""


@contextmanager
def simulated_curses(caller_terminal: TerminalOfCaller, show: ShowTerminal) -> Iterator[None]:
    """Let curses wait for keys in simulated time within the ``with`` block."""
    with ExitStack() as stack:
        when_loaded(stack, "_curses", partial(_simulate_curses, stack, caller_terminal, show))
        yield


def _simulate_curses(
    stack: ExitStack, caller_terminal: TerminalOfCaller, show: ShowTerminal
) -> None:
    import _curses

    limits_ms: dict[int, int] = {}
    all_ms = [_FOR_EVER]
    limit = _curses.window.timeout
    for name in _READS:
        making = partial(_reading, caller_terminal, limits_ms, all_ms, limit)
        replace_member(stack, _curses.window, name, making)
    replace_member(stack, _curses.window, "refresh", partial(_drained, caller_terminal))
    replace_member(stack, _curses.window, "nodelay", partial(_limiting, limits_ms, _of_nodelay))
    replace_member(stack, _curses.window, "timeout", partial(_limiting, limits_ms, int))
    redirect(stack, _curses.doupdate, partial(_drained, caller_terminal))
    redirect(stack, _curses.halfdelay, partial(_halving, all_ms))
    for function in (_curses.setupterm, _curses.initscr):
        redirect(stack, function, partial(_beginning, caller_terminal, show))
    redirect(stack, _curses.endwin, partial(_ending, caller_terminal, show))


def _beginning(
    caller_terminal: TerminalOfCaller, show: ShowTerminal, real: Callable[..., Any]
) -> Callable[..., Any]:
    def begin(*arguments: Any, **options: Any) -> Any:
        terminal = caller_terminal()
        if terminal is None:
            refuse_reading(f"curses.{real.__name__}()")
        else:
            show(terminal, True)
        return real(*arguments, **options)

    return begin


def _ending(
    caller_terminal: TerminalOfCaller, show: ShowTerminal, real: Callable[[], Any]
) -> Callable[[], Any]:
    def end() -> Any:
        try:
            return real()
        finally:
            terminal = caller_terminal()
            if terminal is not None:
                terminal.drain()
                show(terminal, False)

    return end


def _drained(caller_terminal: TerminalOfCaller, real: Any) -> Any:
    """Discard what is shown."""

    def shown(*arguments: Any) -> Any:
        terminal = caller_terminal()
        if terminal is not None:
            terminal.drain()
        return real(*arguments)

    return shown


def _reading(
    caller_terminal: TerminalOfCaller,
    limits_ms: dict[int, int],
    all_ms: list[int],
    limit: Any,
    real: Any,
) -> Any:
    name = real.__name__

    def read(self: Any, *arguments: Any) -> Any:
        terminal = caller_terminal()
        if terminal is None:
            refuse_reading(f"curses: {name}()")
            return real(self, *arguments)
        terminal.drain()
        limit_ms = limits_ms.get(id(self), all_ms[0])
        if name != "getstr" and not terminal.offer():
            limit(self, 0)
            found = _taken_already(partial(real, self, *arguments))
            limit(self, limit_ms)
            if found is not None:
                return found
        if limit_ms == 0:
            terminal.look()
        else:
            terminal.await_input(None if limit_ms < 0 else limit_ms * _NS_PER_MS)
        return real(self, *arguments)

    return read


def _taken_already(get: Callable[[], Any]) -> Any:
    """Return a key that curses has read before (of an unknown escape sequence), or None."""
    import _curses

    try:
        found = get()
    except _curses.error:
        return None
    return None if found == _NO_KEY else found


def _limiting(limits_ms: dict[int, int], to_ms: Callable[[Any], int], real: Any) -> Any:
    def limit(self: Any, value: Any) -> Any:
        limits_ms[id(self)] = to_ms(value)
        return real(self, value)

    return limit


def _of_nodelay(flag: Any) -> int:
    return 0 if flag else _FOR_EVER


def _halving(all_ms: list[int], real: Callable[[int], Any]) -> Callable[[int], Any]:
    def halfdelay(tenths: int, /) -> Any:
        all_ms[0] = tenths * 100
        return real(tenths)

    return halfdelay


_STEP_NS = 1_000_000
_dup = copy_of(os.dup)
_dup2 = copy_of(os.dup2)


class Terminals:
    """The terminals of mains. While a main runs, its terminal is descriptor 0 (and 1, for
    curses)."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._stdin = sys.stdin
        self._real: dict[int, int] = {}
        self._at: dict[int, Terminal | None] = {}
        self._all: dict[SimulatedProgram, Terminal] = {}
        runtime.programs.stdin_of = self.stdin_of

    @property
    def present(self) -> Terminal | None:
        """The terminal of the running main, if it has one."""
        return self._all.get(self._runtime.programs.present)

    def make(self, programs: Sequence[SimulatedProgram], start_ns: int) -> None:
        """Make the terminals of mains; times of input count from ``start_ns``."""
        for program in programs:
            assert program.entry is not None
            if program.entry.stdin is not None:
                self._all[program] = Terminal(self._runtime, program.entry.stdin, start_ns)
                self._runtime.programs.on_enter = self._enter

    def hand_over(self, program: SimulatedProgram, successor: SimulatedProgram) -> None:
        """Give the terminal of a main to the one that starts again."""
        if program in self._all:
            self._all[successor] = self._all[program]

    def stdin_of(self, program: SimulatedProgram) -> Any:
        """Return the ``sys.stdin`` of a main."""
        terminal = self._all.get(program)
        return NoTerminal(self._stdin) if terminal is None else terminal.stream

    def show(self, terminal: Terminal, has_screen: bool) -> None:
        """Send the output of the running main to its terminal, or not."""
        terminal.has_screen = has_screen
        self._enter(self._runtime.programs.present)

    def _enter(self, program: SimulatedProgram) -> None:
        terminal = self._all.get(program)
        self._put(0, terminal)
        self._put(1, terminal if terminal is not None and terminal.has_screen else None)

    def _put(self, number: int, terminal: Terminal | None) -> None:
        """Make a terminal (None: the original) a standard stream of the process."""
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
def simulated_terminals(runtime: Runtime) -> Iterator[Terminals]:
    """Let mains read from their simulated terminals, and no node from the real one."""
    terminals = Terminals(runtime)
    real_stdin = sys.stdin
    with ExitStack() as stack:
        stack.callback(setattr, sys, "stdin", real_stdin)
        sys.stdin = NoTerminal(real_stdin)
        stack.callback(terminals.close)
        redirect(stack, builtins.input, _inputs)
        redirect(stack, os.read, lambda real: _reads(terminals, real))
        redirect(stack, select.select, lambda real: _selects(terminals, real))
        stack.enter_context(
            simulated_curses(lambda: _terminal_of_caller(terminals), terminals.show)
        )
        yield terminals


def _terminal_of_caller(terminals: Terminals) -> Terminal | None:
    """Return the terminal of the calling main, None for other code."""
    runtime = calling_runtime()
    return None if runtime is None or runtime.event.handle is None else terminals.present


def _inputs(real: Callable[..., str]) -> Callable[..., str]:
    def input_(prompt: object = "", /) -> str:
        runtime = calling_runtime()
        if runtime is None or runtime.event.handle is None:
            return real(prompt)
        if isinstance(sys.stdin, NoTerminal):
            refuse_reading("input()")
            return real(prompt)
        output = sys.stdout  # of the node, as all that it prints
        output.write(str(prompt))
        output.flush()
        line = sys.stdin.readline()
        if not line:
            raise EOFError
        return line.removesuffix("\n")

    return input_


def _reads(terminals: Terminals, real: Callable[[int, int], bytes]) -> Callable[..., bytes]:
    def read(fd: int, size: int, /) -> bytes:
        if fd == 0:
            terminal = _terminal_of_caller(terminals)
            if terminal is not None:
                return terminal.read(size)
            refuse_reading("os.read(0)")
        return real(fd, size)

    return read


def _selects(terminals: Terminals, real: Callable[..., Any]) -> Callable[..., Any]:
    def ready(
        reads: Any, writes: Any, others: Any, timeout: float | None = None, /
    ) -> tuple[list[Any], list[Any], list[Any]]:
        terminal = _terminal_of_caller(terminals)
        waited_for = list(reads) if terminal is not None else []
        if terminal is None or not any(_is_stdin(one) for one in waited_for):
            return real(reads, writes, others, timeout)  # type: ignore[no-any-return]
        kinds = [waited_for, list(writes), list(others)]
        alone = sum(map(len, kinds)) == 1
        runtime = terminals._runtime
        until_ns = None if timeout is None else runtime.loop.now_ns + waiting_ns(timeout)
        while True:
            terminal.offer()
            found = real(*kinds, 0)
            left_ns = None if until_ns is None else until_ns - runtime.loop.now_ns
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
                wait(runtime, "one of several descriptors", for_ns=step_ns, quiet=True)

    return ready


def _is_stdin(stream: Any) -> bool:
    if isinstance(stream, int):
        return stream == 0
    fileno = getattr(stream, "fileno", None)
    return fileno is not None and fileno() == 0
