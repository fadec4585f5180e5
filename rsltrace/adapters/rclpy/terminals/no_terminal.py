"""``sys.stdin`` of those whom the job gives no terminal: reading from it is an error."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any, NoReturn

from rsltrace.adapters.rclpy.stacks.simulated_sleep import simulated_stacks
from rsltrace.adapters.rclpy.stacks.stacks import Stacks
from rsltrace.errors import UnsupportedError

_DEBUGGERS = ("bdb", "cmd", "code", "pdb", "IPython", "prompt_toolkit", "debugpy", "pydevd")


class NoTerminal:
    """Is the real stream to whoever drives the run, and to debuggers."""

    def __init__(self, real: Any) -> None:
        self._real = real

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    @property
    def buffer(self) -> NoTerminal:
        """The stream of bytes below."""
        return NoTerminal(self._real.buffer)

    def read(self, *arguments: Any) -> Any:
        """Read all, or so much."""
        refuse("sys.stdin.read()")
        return self._real.read(*arguments)

    def readline(self, *arguments: Any) -> Any:
        """Read a line."""
        refuse("sys.stdin.readline()")
        return self._real.readline(*arguments)

    def readlines(self, *arguments: Any) -> Any:
        """Read all lines."""
        refuse("sys.stdin.readlines()")
        return self._real.readlines(*arguments)

    def __iter__(self) -> Iterator[Any]:
        refuse("for line in sys.stdin")
        return iter(self._real)

    def __next__(self) -> Any:
        refuse("next(sys.stdin)")
        return next(self._real)


def refuse(call: str) -> None:
    """Raise ``UnsupportedError`` if a node's code reads (and no debugger in it)."""
    stacks = simulated_stacks()
    if stacks is None or stacks.event.handle is None or _is_debugged(sys._getframe(2)):
        return
    _fail(stacks, call)


def _fail(stacks: Stacks, call: str) -> NoReturn:
    program = stacks.programs.present
    if program.entry is None:
        raise UnsupportedError(
            f"{call}: a 'node' of a job has no terminal to read from: make it a function that "
            "spins it (main:), and give that entry what is typed: stdin: [...]"
        )
    raise UnsupportedError(
        f"{call}: {program.label} reads from its terminal, and the job does not say what is typed "
        "there: give its entry a file or a list, such as stdin: [yes, {at: 2s, keys: q}]"
    )


def _is_debugged(frame: FrameType | None) -> bool:
    while frame is not None:
        if str(frame.f_globals.get("__name__", "")).partition(".")[0] in _DEBUGGERS:
            return True
        frame = frame.f_back
    return False
