"""A child process and the socket to it: starting, talking, reaping, and leaving none behind."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import struct
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from rsltrace.doors.processes.wire import HEAD, RECORD, Told
from rsltrace.errors import JobError

_ROOM = 1 << 16
_HEAD_SIZE = HEAD.size
_LOOK_S = 0.2
_GRACE_S = 2.0
_NO_RANDOM_ADDRESSES = 0x0040000
_PRESENT = 0xFFFFFFFF
_LOST_LINK = 120  # of native/link.cpp


@dataclass(frozen=True, slots=True)
class Ended:
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
        if self.status >= 0:
            return f"ended with exit status {self.status}"
        with suppress(ValueError):
            return f"was killed by {signal.Signals(-self.status).name}"
        return f"was killed by signal {-self.status}"


class Child:
    """A running executable with the library in it, in a process group of its own.

    :raises JobError: if it cannot be started.
    """

    def __init__(
        self,
        argv: Sequence[str],
        environment: Mapping[str, str],
        folder: Path | None,
        name: str,
    ) -> None:
        self._name = name
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with there:
            # A reader that looks up now and then sees the end of a child whose own children live.
            here.setsockopt(
                socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", 0, int(_LOOK_S * 1e6))
            )
            link = f"{there.fileno()}:{os.getpid()}"
            try:
                with _addresses_as_they_are():
                    self._process = subprocess.Popen(
                        list(argv),
                        env={**environment, "RSLTRACE_LINK": link},
                        cwd=folder,
                        stdin=subprocess.DEVNULL,
                        pass_fds=(there.fileno(),),
                        start_new_session=True,
                    )
            except OSError as error:
                here.close()
                raise JobError(f"{name} cannot be started: {error.strerror}: {argv[0]}") from error
        self._socket = here
        self._there = b""
        self._room = memoryview(bytearray(_ROOM))
        self._patience = 0

    @property
    def pid(self) -> int:
        """The number of the process."""
        return self._process.pid

    def send(self, data: bytes) -> None:
        """Send to the process; one that is gone is noticed by ``receive``."""
        with suppress(BrokenPipeError, ConnectionResetError):
            self._socket.sendall(data)

    def receive(self) -> memoryview | None:
        """Return the next batch, None if the process has ended; it holds until the next call."""
        there, self._there = self._there, b""
        if not there:
            count = self._read_into(self._room)
            if not count:
                return None
            if count >= _HEAD_SIZE:
                size: int = HEAD.unpack_from(self._room)[0]
                if count == _HEAD_SIZE + size:  # nearly always
                    return self._room[_HEAD_SIZE:count]
            there = bytes(self._room[:count])
        return self._assembled(there)

    def _assembled(self, data: bytes) -> memoryview | None:
        """Return the batch that begins with ``data``, of which the rest is still to come."""
        parts, count, size = [data], len(data), -1
        while size < 0 or count < size:
            if size < 0 and count >= _HEAD_SIZE:
                parts = [b"".join(parts)]
                size = _HEAD_SIZE + HEAD.unpack_from(parts[0])[0]
                continue
            more = self._read_into(self._room)
            if not more:
                return None
            parts.append(bytes(self._room[:more]))
            count += more
        whole = b"".join(parts)
        self._there = whole[size:]
        return memoryview(whole)[_HEAD_SIZE:size]

    def give_up_after(self, seconds: float) -> None:
        """Kill the process if it says nothing for so long (real time)."""
        self._patience = int(seconds / _LOOK_S)

    def _read_into(self, room: memoryview) -> int:
        """Read what there is, at least something; 0 if the process has ended."""
        looks = 0
        while True:
            try:
                return self._socket.recv_into(room)
            except BlockingIOError:
                if self._process.poll() is not None:
                    with suppress(BlockingIOError):  # what it said before
                        return self._socket.recv_into(room, 0, socket.MSG_DONTWAIT)
                    return 0
                looks += 1
                if looks == self._patience:
                    self.kill()
                    return 0
            except ConnectionResetError:
                return 0

    def reap(self) -> Ended:
        """Wait for the end of a process that says no more; one that lives on is killed."""
        try:
            status = self._process.wait(_GRACE_S)
            return Ended(status, "closed" if status == _LOST_LINK else "")
        except subprocess.TimeoutExpired:
            self.kill()
            return Ended(self._process.returncode, "closed")

    def dismiss(self) -> None:
        """End the process: it is told to, and killed if it does not."""
        self.send(RECORD.pack(0, Told.KILL))
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_GRACE_S)
        self.kill()

    def kill(self) -> None:
        """Kill the process with all that it has started."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._socket.close()


@contextmanager
def _addresses_as_they_are() -> Iterator[None]:
    """Let children have the same addresses in every run, where the system allows it."""
    personality = ctypes.CDLL(None).personality
    before = personality(ctypes.c_ulong(_PRESENT))
    if before >= 0:
        personality(ctypes.c_ulong(before | _NO_RANDOM_ADDRESSES))
    try:
        yield
    finally:
        if before >= 0:
            personality(ctypes.c_ulong(before))
