"""A child process and the link to it: starting, talking, reaping, and leaving none behind."""

from __future__ import annotations

import fcntl
import mmap
import os
import select
import struct
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any

from rsltrace.adapters.processes.wire import RECORD, CommandKind, WireError
from rsltrace.child_processes import how_ended, kill_group
from rsltrace.compiled import core
from rsltrace.errors import JobError
from rsltrace.fast_dataclass import dataclass
from rsltrace.guard.pin import fix_addresses
from rsltrace.guard.redirect import copy_of

# Memory that a process and the loop both see (``native/shared.h``): files in memory that grow.

_LENGTH = struct.Struct("<Q")
_SIZE = 1 << 16
_TURNS = 32
"""Where what a process has said begins: behind the length, and whose turn it is (``turns.h``)."""


class SharedMemory:
    """A file in memory, mapped; it never shrinks."""

    def __init__(self, name: str) -> None:
        self.fd = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(self.fd, _SIZE)
        fcntl.fcntl(self.fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)  # what is mapped stays there
        self._look_again()

    def _look_again(self) -> None:
        self.data = mmap.mmap(self.fd, 0)
        self.size = len(self.data)

    def grow(self, size: int) -> None:
        """Have room for twice so many bytes."""
        os.ftruncate(self.fd, 2 * size)
        self._look_again()

    def has(self, size: int) -> bool:
        """Return whether there are so many bytes, now that the process may have made it grow."""
        with suppress(OSError, ValueError):
            self._look_again()
        return size <= self.size

    def close(self) -> None:
        """Give the file back; what is mapped goes with its last user."""
        if self.fd >= 0:
            os.close(self.fd)
        self.fd = -1


Batch = tuple[mmap.mmap, int, int]
"""Whole records that a process has said: the memory, and where in it they begin and end."""


class ProcessMessages(SharedMemory):
    """What a process has said and nobody has taken: the length, then whole records."""

    def batch(self) -> Batch:
        """Return what is there; it holds until ``taken``.

        :raises WireError: if that is nothing that makes sense.
        """
        end = _TURNS + _LENGTH.unpack_from(self.data)[0]
        if end > self.size and not self.has(end):
            raise WireError("a process has sent what is no batch")
        return self.data, _TURNS, end

    def taken(self) -> None:
        """Make room for the next batch."""
        _LENGTH.pack_into(self.data, 0, 0)


# What the kernel says of a process: whether it is there, and whether it gets on with its life.

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


_write = copy_of(os.write)  # these are not what the guard gives nodes
_epoll: Any = getattr(select, "epoll", None)  # Linux has it, and only there are processes run
_TURN = b"\0"
_LOOK_S = 0.2
_GRACE_S = 2.0
_LOST_LINK = 120  # of native/link.cpp
_START_OF_STACK = 1 << 16
"""What command line and environment take there, or a multiple of it; one variable may have twice
so many bytes."""
_MOVED = 1 << 12
"""Allocation noise moves the stack by less."""


@dataclass(frozen=True, slots=True)
class ProcessEnd:
    """How a process ended: its exit status (negative: the signal that killed it), in words.

    ``broken_link`` says what it has done to the link, if that is why it was ended.
    """

    status: int
    broken_link: str = ""

    @property
    def failed(self) -> bool:
        """Whether that was no orderly end."""
        return self.status != 0 or self.broken_link != ""

    @property
    def said(self) -> str:
        """What happened, as the end of a sentence."""
        if self.broken_link:
            return f"{self.broken_link} the descriptor by which rsltrace runs it"
        return how_ended(self.status)


class ProcessHandle:
    """A running executable with the library in it, in a process group of its own.

    ``fixed`` and ``noise``: see ``ProcessProgram``. What it has said lies in ``said``.

    :raises JobError: if it cannot be started.
    """

    def __init__(
        self,
        argv: Sequence[str],
        environment: Mapping[str, str],
        folder: Path | None,
        name: str,
        *,
        fixed: bool | None = True,
        noise: int = 0,
    ) -> None:
        self._name = name
        self.said, self._told = ProcessMessages("rsltrace-said"), SharedMemory("rsltrace-told")
        self._link = ExitStack()
        turns, self._turns = os.pipe()
        bell = os.eventfd(0, os.EFD_CLOEXEC)
        epoll = self._link.enter_context(_epoll(2))
        self._link.callback(os.close, self._turns)
        self._link.callback(os.close, bell)
        epoll.register(bell, select.EPOLLIN | select.EPOLLET)  # needs no read
        epoll.register(self._turns, 0)  # tells when nobody reads any more
        self._has_slept: Callable[[], bool] = lambda: True
        self._has_spoken: Callable[[], bool] = lambda: False
        if core is not None:  # else both sleep until they are woken
            shared = core.turns_of(self.said.fd)
            self._has_slept = partial(core.turn_given, shared)
            self._has_spoken = partial(core.turn_over, shared)
        self._poll, self._rung = epoll.poll, (bell, select.EPOLLIN)
        files = (turns, bell, self.said.fd, self._told.fd)
        link = ":".join(str(number) for number in (os.getpid(), *files, noise))
        try:
            with nullcontext() if fixed is None else _addresses(fixed):
                self._process = subprocess.Popen(
                    list(argv),
                    env=_of_one_size(argv, {**environment, "RSLTRACE_LINK": link}, noise % _MOVED),
                    cwd=folder,
                    stdin=subprocess.DEVNULL,
                    pass_fds=files,
                    start_new_session=True,
                )
        except OSError as error:
            self._close_files()
            raise JobError(
                f"{name} cannot be started: {error.strerror}: {Path(argv[0])}"
            ) from error
        finally:
            os.close(turns)
        self._patience = 0
        self._life: Life | None = None

    @property
    def pid(self) -> int:
        return self._process.pid

    def code_files(self) -> set[str]:
        """Return the files that it has loaded as code: the program, libraries, plugins."""
        found = set()
        with suppress(OSError):
            for line in Path(f"/proc/{self.pid}/maps").read_text(errors="replace").splitlines():
                _, access, *_, path = line.split(maxsplit=5)
                if "x" in access and path.startswith("/"):
                    found.add(path)
        return found

    def send(self, data: bytes) -> None:
        """Send to the process; one that is gone is noticed by ``receive``."""
        told, size = self._told, len(data)
        if size > told.size:
            told.grow(size)
        told.data[:size] = data
        try:
            if self._has_slept():
                _write(self._turns, _TURN)
        except BrokenPipeError:
            pass

    def receive(self) -> Batch | None:
        """Return the next batch, None if the process has ended; it holds until ``taken``.

        :raises WireError: if the process has written something of its own to the link.
        """
        looks = 0
        while not self._has_spoken():
            events = self._poll(_LOOK_S, 2)
            if self._rung in events:
                if core is None:
                    break
                continue
            # A process may be gone whose children have its end of the link.
            if events or self._process.poll() is not None:
                return None
            looks += self._life is not None and self._life.goes_on()
            if looks > self._patience:
                self.kill()
                return None
        return self.said.batch()

    def give_up_after(self, seconds: float) -> None:
        """Kill the process if it says nothing for so long, by its own time (``Life``)."""
        self._patience, self._life = int(seconds / _LOOK_S), Life(self.pid)

    def reap(self) -> ProcessEnd:
        """Wait for the end of a process that says no more; one that lives on is killed."""
        while self._process.poll() is None:
            if has_memory(self.pid):  # what ends has given its memory back before its descriptors
                self.kill()
                return ProcessEnd(self._process.returncode, "closed")
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_LOOK_S)
        status = self._process.returncode
        return ProcessEnd(status, "closed" if status == _LOST_LINK else "")

    def dismiss(self) -> None:
        """End the process: by a command, and by a kill if it does not obey."""
        self.send(RECORD.pack(0, CommandKind.KILL))
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_GRACE_S)
        self.kill()

    def kill(self) -> None:
        kill_group(self._process.pid)
        self._process.wait()
        self._link.close()

    def close(self) -> None:
        """Kill the process, and give back what belongs to it."""
        self.kill()
        self._close_files()

    def _close_files(self) -> None:
        self._link.close()
        self.said.close()
        self._told.close()


def _of_one_size(argv: Sequence[str], environment: dict[str, str], moved: int) -> dict[str, str]:
    """Lengthen the last variable: command line and environment begin the stack, and all that comes
    after them moves with their size; and by so many bytes more."""
    texts = [argv[0], *argv, *map("=".join, environment.items())]  # the kernel adds the program
    size = sum(len(os.fsencode(text)) + 1 for text in texts)
    pointers = (len(argv) + len(environment)) * 8
    size += pointers + pointers % 16  # as the stack is aligned
    name, value = environment.popitem()
    return {**environment, name: value + " " * (-size % _START_OF_STACK + moved)}


@contextmanager
def _addresses(fixed: bool) -> Iterator[None]:
    """Let children have fixed or random addresses, where the system allows it."""
    changed = fix_addresses(fixed)
    try:
        yield
    finally:
        if changed:
            fix_addresses(not fixed)
