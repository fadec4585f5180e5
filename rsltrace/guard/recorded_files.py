"""Files, environment and sockets whose answers are recorded (mode ``record``), and given again."""

from __future__ import annotations

import io
import os
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import FrameType
from typing import Any

from rsltrace.guard.callers import user_frame
from rsltrace.guard.guard import Guard, engaged
from rsltrace.guard.redirect import Redirected, copy_of
from rsltrace.model.finding import Mode, Source

BYTES_MAX = 64 << 20


class _Content(io.BytesIO):
    """What a file held when it was opened."""

    def __init__(self, content: bytes, name: str) -> None:
        super().__init__(content)
        self.name = name

    def writable(self) -> bool:
        """Return False, as a file opened for reading does."""
        return False


def _recording(source: Source, frame: FrameType) -> Guard | None:
    """Return the guard if user code asks and the job records this source."""
    guard = engaged()
    if guard is None or user_frame(frame, guard.packages) is None:
        return None
    return guard if guard.mode(source, frame) is Mode.RECORD else None


def _opening(real: Callable[..., Any]) -> Any:
    def open_(
        file: Any,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
        *more: Any,
        **options: Any,
    ) -> Any:
        frame = sys._getframe(1)
        reads = isinstance(mode, str) and not set(mode) & set("wax+")
        guard = _recording(Source.FILE, frame) if reads and not isinstance(file, int) else None
        if guard is None:
            return real(file, mode, buffering, encoding, errors, newline, *more, **options)
        name = os.fsdecode(file)

        def content() -> bytes:
            with real(file, "rb") as opened:
                data: bytes = opened.read(BYTES_MAX + 1)
            if len(data) > BYTES_MAX:
                raise OSError(27, f"{name} is too large to be recorded")
            return data

        held = _Content(guard.recorded(Source.FILE, f"open({name!r})", content, frame), name)
        if "b" in mode:
            return held
        return io.TextIOWrapper(held, encoding, errors, newline)

    return open_


def _looking(name: str, real: Callable[..., Any]) -> Any:
    def stat(path: Any, *more: Any, **options: Any) -> Any:
        frame = sys._getframe(1)
        guard = None if isinstance(path, int) else _recording(Source.FILE, frame)
        if guard is None:
            return real(path, *more, **options)
        call = f"{name}({os.fsdecode(path)!r})"

        def fields() -> list[Any]:
            found = real(path, *more, **options)
            return [list(found), found.st_atime_ns, found.st_mtime_ns, found.st_ctime_ns]

        values, *times = guard.recorded(Source.FILE, call, fields, frame)
        names = ("st_atime_ns", "st_mtime_ns", "st_ctime_ns")
        return os.stat_result(tuple(values), dict(zip(names, times, strict=True)))

    return stat


_RECEIVING = ("recv", "recvfrom")
_RECEIVING_INTO = ("recv_into", "recvfrom_into")
_OTHERS = ("connect", "connect_ex", "send", "sendall", "sendto", "bind", "getsockname")
_MORE = ("getpeername", "shutdown", "listen", "setsockopt")


def _of_socket(name: str, real: Callable[..., Any]) -> Any:
    call = f"socket.{name}()"

    def method(self: Any, *arguments: Any, **options: Any) -> Any:
        frame = sys._getframe(1)
        guard = _recording(Source.SOCKET, frame)
        if guard is None:
            return real(self, *arguments, **options)
        return guard.recorded(Source.SOCKET, call, lambda: real(self, *arguments, **options), frame)

    return method


def _into(name: str, real: Callable[..., Any]) -> Any:
    call = f"socket.{name}()"

    def method(self: Any, buffer: Any, nbytes: int = 0, flags: int = 0) -> Any:
        frame = sys._getframe(1)
        guard = _recording(Source.SOCKET, frame)
        if guard is None:
            return real(self, buffer, nbytes, flags)

        def receive() -> list[Any]:
            found = real(self, buffer, nbytes, flags)
            count = found[0] if isinstance(found, tuple) else found
            return [bytes(memoryview(buffer).cast("B")[:count]), found]

        data, found = guard.recorded(Source.SOCKET, call, receive, frame)
        memoryview(buffer).cast("B")[: len(data)] = data
        return found

    return method


def _resolving(real: Callable[..., Any]) -> Any:
    def getaddrinfo(*arguments: Any, **options: Any) -> Any:
        frame = sys._getframe(1)
        guard = _recording(Source.SOCKET, frame)
        if guard is None:
            return real(*arguments, **options)
        return guard.recorded(
            Source.SOCKET, "socket.getaddrinfo()", lambda: real(*arguments, **options), frame
        )

    return getaddrinfo


@contextmanager
def recorded_files() -> Iterator[None]:
    """Let files that are read, their times, and sockets answer from the trace in a re-run."""
    with ExitStack() as stack:

        def redirect(function: Any, make: Callable[[Any], Any]) -> None:
            stack.callback(Redirected(function, make(copy_of(function))).restore)

        redirect(io.open, _opening)
        for name in ("stat", "lstat"):
            # Outermost: what is recorded here is no finding of the watch below.
            redirect(getattr(os, name), partial(_looking, f"os.{name}"))
        import _socket

        redirect(_socket.getaddrinfo, _resolving)
        kind: Any = socket.socket
        makers = [(name, _of_socket) for name in (*_RECEIVING, *_OTHERS, *_MORE)]
        for name, make in [*makers, *((name, _into) for name in _RECEIVING_INTO)]:
            stack.callback(delattr, kind, name)
            setattr(kind, name, make(name, getattr(kind, name)))
        yield
