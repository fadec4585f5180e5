"""Child processes that never outlive their campaign: a Ctrl-C ends them all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

# Ends with the process that started it, and does not load what lies in the present folder.
_PROGRAM = """
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 9)
if os.getppid() != int(sys.argv.pop(1)):
    sys.exit(137)
del sys.path[0]
sys.path.append(sys.argv.pop(1))
import runpy
module = sys.argv.pop(1)
sys.argv[0] = 'rsltrace'
runpy.run_module(module, run_name='__main__')
"""
OWN_FOLDER = Path(__file__).resolve().parents[1]
"""The folder that this package is in."""


def rsltrace_command(words: Sequence[str], module: str = "rsltrace") -> list[str]:
    """Return a command line of this very rsltrace; its process ends with the present one."""
    return [sys.executable, "-c", _PROGRAM, str(os.getpid()), str(OWN_FOLDER), module, *words]


@dataclass(frozen=True, slots=True)
class Done:
    """How a process ended. ``timed_out``: it was killed because it took too long."""

    exit_code: int
    output: str
    errors: str
    timed_out: bool = False


class Processes:
    """Starts processes, each in a session of its own, from several threads; ``kill`` ends all."""

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
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
