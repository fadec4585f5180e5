"""What the kernel says of a process: whether it is there, and whether it gets on with its life."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_TICK_S = 1 / os.sysconf("SC_CLK_TCK")
_WAITS_FOR_NOTHING = "S"
"""The state of a thread that sleeps until something happens. One that may run, waits for a disk or
was stopped has another."""
_CPU_S = 0.1
"""What a process that goes in circles uses between two looks, at least."""


def has_memory(pid: int) -> bool:
    """Return whether a process can still run code; one that is ending has no memory any more."""
    return any(text.split()[0] != "0" for text in _of_threads(pid, "statm"))


def _of_threads(pid: int, name: str) -> Iterator[str]:
    """Yield what the kernel has of each thread of a process, of those that have not ended."""
    for path in Path(f"/proc/{pid}/task").glob(f"*/{name}"):
        with suppress(OSError):
            yield path.read_text()


class Life:
    """Tells a process that is slow from one that does nothing or goes in circles: the time that it
    takes is not that of a machine that is busy with others, or that somebody has stopped."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._cpu_s = self._look()[1]

    def goes_on(self) -> bool:
        """Return whether it has had time of its own since the last look: it was computing, or all
        of its threads were waiting."""
        states, cpu_s = self._look()
        if cpu_s - self._cpu_s >= _CPU_S:
            self._cpu_s = cpu_s
            return True
        return set(states) == {_WAITS_FOR_NOTHING}

    def _look(self) -> tuple[str, float]:
        """Return the states of its threads, one letter each, and the CPU time of all of them."""
        states, ticks = "", 0
        for text in _of_threads(self._pid, "stat"):
            state, *fields = text.rpartition(")")[2].split()
            states += state
            ticks += int(fields[10]) + int(fields[11])
        return states, ticks * _TICK_S
