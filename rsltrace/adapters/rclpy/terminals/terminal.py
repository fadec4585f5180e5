"""A main's terminal: a pseudo-terminal of the system, with input from the job.

The system's line discipline works as natively (lines, raw keys, ``termios``). Only the time is
simulated: keys are typed at their time when the main reads, so that no flush loses them, and
reading waits in simulated time.
"""

from __future__ import annotations

import fcntl
import io
import os
import select
import struct
import termios
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from rsltrace.adapters.rclpy.concurrency.blocking_calls import POLL_NS, wait
from rsltrace.adapters.rclpy.concurrency.runtime import BlockedCall, Runtime
from rsltrace.adapters.rclpy.entry import TypedInput
from rsltrace.guard.redirect import copy_of

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
