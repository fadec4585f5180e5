"""File descriptors whose answers are recorded: ``os.open``, ``os.read``, terminals, devices.

In a re-run such a descriptor is not connected: reads come from the trace, writes are dropped.
"""

from __future__ import annotations

import fcntl
import io
import os
import stat
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import FrameType
from typing import Any

from rsltrace.guard.descriptor_table import RecordedDescriptor, number_of
from rsltrace.guard.guard import Guard, engaged
from rsltrace.guard.process_ids import real_path
from rsltrace.guard.redirect import copy_of, redirect
from rsltrace.guard.waiting import wait_readable, wait_recorded, wait_unrecorded, waiting_guard
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource

_RECORD = GuardMode.RECORD
_MAKES_FILES = os.O_CREAT | os.O_TRUNC | getattr(os, "O_TMPFILE", 0)
_PLAIN = (
    *("write", "writev", "pread", "fsync", "fdatasync", "ftruncate", "lseek", "isatty"),
    *("ttyname", "tcgetpgrp", "tcsetpgrp"),
)
_TERMINAL = (
    *("tcgetattr", "tcsetattr", "tcsendbreak", "tcdrain", "tcflush", "tcflow"),
    *("tcgetwinsize", "tcsetwinsize"),
)
_real_fstat = copy_of(os.fstat)
_isatty = copy_of(os.isatty)
_get_blocking = copy_of(os.get_blocking)


def recording_guard(source: NondeterminismSource, frame: FrameType) -> Guard | None:
    """Return the guard if user code calls and the job records this source."""
    guard = engaged()
    if guard is None or guard.mode(source, frame) is not _RECORD:
        return None
    return guard if guard.is_user_call(frame) else None


def recording_call(source: NondeterminismSource, call: str, real: Callable[..., Any]) -> Any:
    """Return the replacement of a function whose answers are recorded as they are."""

    def function(*arguments: Any, **options: Any) -> Any:
        frame = sys._getframe(1)
        guard = recording_guard(source, frame)
        if guard is None:
            return real(*arguments, **options)
        return guard.record(source, call, lambda: real(*arguments, **options), frame)

    return function


def recorded_descriptor(fd: object) -> tuple[Guard, RecordedDescriptor] | None:
    """Return the guard and its entry of a descriptor, if its answers are recorded."""
    guard = engaged()
    if guard is None:
        return None
    found = guard.descriptors.find(fd)
    return None if found is None or found.is_folder else (guard, found)


def unconnected_descriptor(flags: int = 0) -> int:
    """Return a descriptor for a re-run that leads nowhere and that event loops accept."""
    nonblocking = os.EFD_NONBLOCK if flags & os.O_NONBLOCK else 0
    return os.eventfd(0, os.EFD_CLOEXEC | nonblocking)


def _opening(real: Callable[..., int]) -> Any:
    def open_(path: Any, flags: int, *more: Any, **options: Any) -> int:
        path = real_path(path)
        frame = sys._getframe(1)
        wanted = not flags & _MAKES_FILES and flags & os.O_ACCMODE != os.O_WRONLY
        guard = recording_guard(NondeterminismSource.FILE, frame) if wanted else None
        if guard is None:
            return real(path, flags, *more, **options)
        opened: list[int] = []

        def is_folder() -> bool:
            opened.append(real(path, flags, *more, **options))
            return stat.S_ISDIR(os.fstat(opened[0]).st_mode)

        call = f"os.open({os.fsdecode(path)!r})"
        folder = bool(guard.record(NondeterminismSource.FILE, call, is_folder, frame))
        if not opened:  # a folder is the run's own, or its listing is not recorded anyway
            opened.append(
                real(path, flags, *more, **options) if folder else unconnected_descriptor(flags)
            )
        guard.descriptors.drop(opened[0])
        guard.descriptors.add(opened[0], NondeterminismSource.FILE, is_folder=folder)
        return opened[0]

    return open_


def _on(module: str, name: str, real: Callable[..., Any]) -> Any:
    """Return the replacement of a function that takes a descriptor and plain values."""
    call = f"{module}.{name}()"

    def function(fd: Any, *arguments: Any, **options: Any) -> Any:
        found = recorded_descriptor(fd)
        if found is None:
            return real(fd, *arguments, **options)
        guard, known = found
        return guard.record(
            known.source,
            call,
            lambda: real(fd, *arguments, **options),
            sys._getframe(1),
            known.number,
        )

    return function


def _recording_fstat(real: Callable[..., Any]) -> Any:
    def fstat(fd: int) -> Any:
        guard = engaged()
        known = guard.descriptors.find(fd) if guard is not None else None
        if guard is None or known is None:
            return real(fd)
        return recorded_stat(
            guard, known.source, "os.fstat()", lambda: real(fd), sys._getframe(1), known.number
        )

    return fstat


def recorded_stat(
    guard: Guard,
    source: NondeterminismSource,
    call: str,
    real: Callable[[], Any],
    frame: FrameType,
    number: int = 0,
) -> os.stat_result:
    """Return the result of ``os.stat`` and the like, from outside or from the trace."""

    def fields() -> list[Any]:
        found = real()
        return [list(found), found.st_atime_ns, found.st_mtime_ns, found.st_ctime_ns]

    values, *times = guard.record(source, call, fields, frame, number)
    names = ("st_atime_ns", "st_mtime_ns", "st_ctime_ns")
    return os.stat_result(tuple(values), dict(zip(names, times, strict=True)))


def _reading(real: Callable[..., bytes]) -> Any:
    def read(fd: int, size: int, /) -> Any:
        found = recorded_descriptor(fd)
        if found is None:
            return _read_unrecorded(fd, lambda: real(fd, size), sys._getframe(1))
        return _read(*found, "os.read()", fd, lambda: real(fd, size), sys._getframe(1))

    return read


def _read_unrecorded(fd: int, real: Callable[[], Any], frame: FrameType) -> Any:
    patient = waiting_guard(frame)
    if patient is not None and _blocks(fd):
        return wait_unrecorded(patient, wait_readable(fd, real), frame)
    return real()


def _blocks(fd: int) -> bool:
    """Return whether a read from a descriptor may have to wait."""
    try:
        kind = _real_fstat(fd).st_mode
        waits = stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind)
        waits = waits or (stat.S_ISCHR(kind) and _isatty(fd))  # a device that a thread plays, too
        return waits and _get_blocking(fd)
    except OSError:
        return False


def _reading_into(real: Callable[..., int]) -> Any:
    def readv(fd: int, buffers: Any, /) -> Any:
        found = recorded_descriptor(fd)
        if found is None:
            return _read_unrecorded(fd, lambda: real(fd, buffers), sys._getframe(1))

        def read() -> bytes:
            return b"".join(map(bytes, buffers))[: real(fd, buffers)]

        data = _read(*found, "os.readv()", fd, read, sys._getframe(1))
        rest = data
        for buffer in buffers:
            view = memoryview(buffer).cast("B")
            view[: len(rest[: len(view)])] = rest[: len(view)]
            rest = rest[len(view) :]
        return len(data)

    return readv


def _read(
    guard: Guard,
    known: RecordedDescriptor,
    call: str,
    fd: int,
    real: Callable[[], bytes],
    frame: FrameType,
) -> Any:
    if _get_blocking(fd) and guard.context.is_aside():
        look = wait_readable(fd, real)
        return wait_recorded(guard, known.source, call, look, frame, number=known.number)
    return guard.record(known.source, call, real, frame, known.number)


def _controlling(real: Callable[..., Any]) -> Any:
    def ioctl(fd: Any, request: int, arg: Any = 0, mutate_flag: bool = True, /) -> Any:
        found = recorded_descriptor(fd)
        if found is None:
            return real(fd, request, arg, mutate_flag)
        guard, known = found
        fills = not isinstance(arg, (int, str, bytes)) and mutate_flag

        def control() -> list[Any]:
            value = real(fd, request, arg, mutate_flag)
            return [value, bytes(arg) if fills else None]

        frame = sys._getframe(1)
        value, after = guard.record(
            known.source, f"fcntl.ioctl({request:#x})", control, frame, known.number
        )
        if fills and after is not None:
            memoryview(arg).cast("B")[:] = after
        return value

    return ioctl


def _closing(real: Callable[[int], None]) -> Any:
    def close(fd: int) -> None:
        guard = engaged()
        if guard is not None:
            guard.descriptors.drop(fd)
        real(fd)

    return close


def _duplicating(real: Callable[..., int]) -> Any:
    def dup(fd: int, /) -> int:
        found = recorded_descriptor(fd)
        copy = real(fd)
        if found is not None:
            found[0].descriptors.drop(copy)
            found[0].descriptors.add(copy, found[1].source)
        return copy

    return dup


def connected_ends(real: Callable[..., Any]) -> Any:
    """Return the replacement of a function that makes two connected descriptors."""

    def ends(*arguments: Any, **options: Any) -> Any:
        made = real(*arguments, **options)
        guard = engaged()
        if guard is not None:
            guard.descriptors.join(*map(number_of, made))
        return made

    return ends


class RawDescriptor(io.RawIOBase):
    """A recorded descriptor or device as ``open`` returns it."""

    def __init__(self, fd: int, mode: str, *, name: object, closes: bool = True) -> None:
        self._fd = fd
        self._reads = "r" in mode or "+" in mode
        self._writes = bool(set(mode) & set("wax+"))
        self._closes = closes
        self.name = name
        self.mode = ("rb+" if self._writes else "rb") if self._reads else "wb"

    def fileno(self) -> int:
        if self.closed:
            raise ValueError("I/O operation on closed file")
        return self._fd

    def readable(self) -> bool:
        """Return whether it was opened for reading."""
        return self._reads

    def writable(self) -> bool:
        """Return whether it was opened for writing."""
        return self._writes

    def seekable(self) -> bool:
        try:
            os.lseek(self.fileno(), 0, os.SEEK_CUR)
        except OSError:
            return False
        return True

    def seek(self, offset: int, whence: int = 0, /) -> int:
        """Go to a position."""
        return os.lseek(self.fileno(), offset, whence)

    def isatty(self) -> bool:
        return os.isatty(self.fileno())

    def readinto(self, buffer: Any, /) -> int | None:
        """Read what is there, at most as much as fits."""
        view = memoryview(buffer).cast("B")
        try:
            data = os.read(self.fileno(), len(view))
        except BlockingIOError:
            return None
        view[: len(data)] = data
        return len(data)

    def write(self, data: Any, /) -> int | None:
        """Write as much as possible at once."""
        try:
            return os.write(self.fileno(), data)
        except BlockingIOError:
            return None

    def close(self) -> None:
        """Close the descriptor, unless ``closefd`` was false."""
        if not self.closed:
            try:
                super().close()
            finally:
                if self._closes:
                    os.close(self._fd)


def open_raw(
    raw: RawDescriptor,
    mode: str,
    buffering: int = -1,
    encoding: str | None = None,
    errors: str | None = None,
    newline: str | None = None,
) -> Any:
    """Return the file object that ``open`` returns in a mode."""
    if buffering == 0:
        if "b" not in mode:
            raise ValueError("can't have unbuffered text I/O")
        return raw
    size = buffering if buffering > 1 else io.DEFAULT_BUFFER_SIZE
    if raw.readable() and raw.writable():
        buffered: Any = io.BufferedRandom(raw, size)
    else:
        buffered = (io.BufferedReader if raw.readable() else io.BufferedWriter)(raw, size)
    if "b" in mode:
        return buffered
    text = io.TextIOWrapper(buffered, encoding, errors, newline, line_buffering=buffering == 1)
    text.mode = mode  # type: ignore[misc]
    return text


@contextmanager
def recorded_descriptors() -> Iterator[None]:
    """Record the answers of descriptors; in a re-run, return them from the trace."""
    makers: list[tuple[Any, str, Callable[[Any], Any]]] = [
        (os, "open", _opening),
        (os, "read", _reading),
        (os, "readv", _reading_into),
        (os, "fstat", _recording_fstat),
        (os, "close", _closing),
        (os, "dup", _duplicating),
        (os, "pipe", connected_ends),
        (os, "pipe2", connected_ends),
        (os, "openpty", connected_ends),
        (fcntl, "ioctl", _controlling),
        *((os, name, partial(_on, "os", name)) for name in _PLAIN),
        *((termios, name, partial(_on, "termios", name)) for name in _TERMINAL),
        *((fcntl, name, partial(_on, "fcntl", name)) for name in ("flock", "lockf")),
    ]
    with ExitStack() as stack:
        for module, name, make in makers:
            function = getattr(module, name, None)  # some are of later versions of Python
            if function is not None:
                redirect(stack, function, make)
        yield
