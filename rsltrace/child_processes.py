"""Child processes: commands of rsltrace itself, how a process ended, and none left behind."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rsltrace.fast_dataclass import dataclass

# No module is loaded from the working directory: not even ctypes. The kernel ends the process with
# its parent (PR_SET_PDEATHSIG), whose number is the second word; "": it does not.
_BEGIN = """
import sys
sys.path[:] = [*filter(None, sys.path), sys.argv.pop(1)]
import ctypes, os
parent = sys.argv.pop(1)
if parent:
    prctl = getattr(ctypes.CDLL(None), 'prctl', None)
    if prctl is not None:
        prctl(1, 9)
    if os.getppid() != int(parent):
        sys.exit(137)
"""
_RUN = """
import runpy
module = sys.argv.pop(1)
sys.argv[0] = 'rsltrace'
runpy.run_module(module, run_name='__main__')
"""
OWN_FOLDER = Path(__file__).resolve().parents[1]
"""The folder that this package is in."""


def rsltrace_command(
    words: Sequence[str],
    module: str = "rsltrace",
    *,
    killed_with_parent: bool = True,
    before: str = "",
) -> list[str]:
    """Return a command line of this installation of rsltrace, which runs ``module`` as a program,
    and the statements of ``before`` first.

    The kernel kills its process with the present one, unless it ends by itself then, because it has
    something to clear away.
    """
    parent = str(os.getpid()) if killed_with_parent else ""
    program = f"{_BEGIN}{before}{_RUN}"
    return [sys.executable, "-c", program, str(OWN_FOLDER), parent, module, *words]


def start_connected(
    module: str, words: Sequence[str] = (), *, killed_with_parent: bool = True, **options: Any
) -> tuple[subprocess.Popen[bytes], socket.socket]:
    """Start a module of rsltrace as a program; return its process and this end of a socket to it.

    The number of the other end is the program's first word. Nothing comes from standard input.
    ``killed_with_parent`` is as for ``rsltrace_command``, ``options`` as for ``subprocess.Popen``.

    :raises OSError: if no process can be made.
    """
    here, there = socket.socketpair()
    with there:
        try:
            process = subprocess.Popen(
                rsltrace_command(
                    [str(there.fileno()), *words], module, killed_with_parent=killed_with_parent
                ),
                stdin=subprocess.DEVNULL,
                pass_fds=(there.fileno(),),
                **options,
            )
        except BaseException:
            here.close()
            raise
    return process, here


def how_ended(exit_code: int) -> str:
    """Return how a process ended, in words; the code is negative for a signal."""
    if exit_code >= 0:
        return f"ended with exit status {exit_code}"
    return f"was killed by {signal_name(-exit_code)}"


def signal_name(number: int) -> str:
    """Return the name of a signal, such as ``SIGSEGV``."""
    with suppress(ValueError):
        return signal.Signals(number).name
    return f"signal {number}"


def kill_group(pid: int) -> None:
    """Kill a process that leads a group, and what it has started."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


@dataclass(frozen=True, slots=True)
class Done:
    """How a process ended. ``timed_out``: it was killed because it took too long."""

    exit_code: int
    output: str
    errors: str
    timed_out: bool = False


class Processes:
    """Starts processes, each in a session of its own, from several threads; ``kill``, or leaving
    its ``with`` block, ends all."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[str]] = set()
        self._over = False

    def run(
        self,
        command: Sequence[str],
        *,
        cwd: Path,
        env: Mapping[str, str],
        timeout_s: float | None = None,
    ) -> Done:
        """Run a command to its end; after ``kill``, nothing more is started."""
        with self._started(command, cwd, env) as process:
            if process is None:
                return Done(-signal.SIGKILL, "", "not started")
            timed_out = False
            try:
                output, errors = process.communicate(timeout=timeout_s)
            except subprocess.TimeoutExpired:
                timed_out = True
                _kill(process)
                output, errors = process.communicate()
            return Done(process.returncode, output, errors, timed_out)

    @contextmanager
    def beside(self, command: Sequence[str]) -> Iterator[None]:
        """Have a command running as long as the ``with`` block lasts."""
        with self._started(command, None, None):
            yield

    @contextmanager
    def _started(
        self, command: Sequence[str], cwd: Path | None, env: Mapping[str, str] | None
    ) -> Iterator[subprocess.Popen[str] | None]:
        with self._lock:
            process = None
            if not self._over:
                process = subprocess.Popen(
                    command,
                    cwd=cwd,
                    env=env,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                    encoding="utf-8",
                    errors="backslashreplace",
                    start_new_session=True,
                )
                self._running.add(process)
        if process is None:
            yield None
            return
        try:
            yield process
        finally:
            _kill(process)
            process.communicate()
            with self._lock:
                self._running.discard(process)

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def kill(self) -> None:
        """End everything that runs, and start nothing more."""
        with self._lock:
            self._over = True
            running = list(self._running)
        for process in running:
            _kill(process)


def _kill(process: subprocess.Popen[str]) -> None:
    """Kill a process and what it has started."""
    if process.poll() is None:
        kill_group(process.pid)
