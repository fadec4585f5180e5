"""The processes of a session: started, spoken with, waited for and killed. None outlives it."""

from __future__ import annotations

import ctypes
import json
import os
import select
import signal
import socket
import sys
import time
from contextlib import suppress
from typing import Any

from rsltrace.child_processes import how_ended, rsltrace_command
from rsltrace.errors import DebugError
from rsltrace.forking import own_children
from rsltrace.line_protocol import Lines

_PR_SET_CHILD_SUBREAPER = 36
_MAIN = "rsltrace.debug.simulation"
_GRACE_S = 2.0


class Lost(DebugError):
    """A process has ended that was asked for something. The message says how."""


class SimProcess:
    def __init__(self, lines: Lines, pid: int) -> None:
        self.lines = lines
        self.pid = pid


class Family:
    """All processes below this one, whoever started them: it is their subreaper."""

    def __init__(self) -> None:
        with suppress(OSError):
            os.setsid()  # a Ctrl-C on the terminal is for the client
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._ended: dict[int, int] = {}

    def start(self, spec: dict[str, Any], output: int) -> SimProcess:
        """Start a process that opens what ``spec`` says; what it prints goes to ``output``.

        :raises DebugError: no process can be made.
        """
        ours, theirs = socket.socketpair()
        number = theirs.fileno()
        command = rsltrace_command([str(number), json.dumps(spec)], _MAIN)
        theirs.set_inheritable(True)
        to_output = [(os.POSIX_SPAWN_DUP2, output, std) for std in (1, 2)]
        from_nowhere = (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0)
        try:
            pid = os.posix_spawn(
                sys.executable, command, os.environ, file_actions=[from_nowhere, *to_output]
            )
        except OSError as error:
            ours.close()
            raise DebugError(f"no process can be made for the simulation: {error}") from error
        finally:
            theirs.close()
        return SimProcess(Lines(ours), pid)

    def reap(self) -> None:
        """Take note of processes that have ended."""
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            self._ended[pid] = status

    def how_ended(self, process: SimProcess) -> str:
        """Return how a process has ended that has closed its socket."""
        end_s = time.monotonic() + _GRACE_S
        while True:
            self.reap()
            status = self._ended.get(process.pid)
            if status is not None:
                return f"its process {how_ended(os.waitstatus_to_exitcode(status))}"
            if time.monotonic() > end_s:
                return "its process does not answer any more"
            select.select([], [], [], 0.01)

    def kill(self, process: SimProcess) -> None:
        process.lines.close()
        if process.pid not in self._ended:
            with suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGKILL)
        self.reap()
        self._ended.pop(process.pid, None)

    def kill_all(self) -> None:
        """End everything below this process, and wait until it is gone."""
        while True:
            self.reap()
            children = own_children()
            if not children:
                return
            for pid in children:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            with suppress(ChildProcessError):
                os.waitpid(-1, 0)


def memory_bytes(pid: int) -> int:
    """Return a process's share of memory (PSS: pages that n processes share count one n-th)."""
    with suppress(OSError, ValueError), open(f"/proc/{pid}/smaps_rollup") as file:
        for line in file:
            if line.startswith("Pss:"):
                return int(line.split()[1]) << 10
    return 0
