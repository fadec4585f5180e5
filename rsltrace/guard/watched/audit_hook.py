"""Calls that Python's audit hooks report: files, processes, sockets, the C library, addresses.

A hook cannot be taken back, so there is one per process, which does nothing while no guard is in
charge.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

from rsltrace.guard.callers import user_frame
from rsltrace.guard.file_report_filter import READERS_OF_CODE, asking_module, is_installed
from rsltrace.guard.frames import caller
from rsltrace.guard.guard import engage, engaged
from rsltrace.trace.model.finding import Mode, Source

_HASHED_BYTES_MAX = 64 << 20
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_PROCESSES = {
    "subprocess.Popen": "subprocess.Popen",
    "os.system": "os.system",
    "os.exec": "os.exec",
    "os.fork": "os.fork",
    "os.forkpty": "os.forkpty",
    "os.posix_spawn": "os.posix_spawn",
    "os.spawn": "os.spawn",
    "os.kill": "os.kill",
}
_SOCKETS = {
    "socket.connect",
    "socket.bind",
    "socket.sendto",
    "socket.sendmsg",
    "socket.getaddrinfo",
    "socket.gethostbyname",
    "socket.gethostbyaddr",
    "socket.gethostname",
}
_ADDRESSES = ("ctypes.addressof", "builtins.id")
FOREIGN = {
    "time": Source.CLOCK,
    "clock": Source.CLOCK,
    "clock_gettime": Source.CLOCK,
    "gettimeofday": Source.CLOCK,
    "rand": Source.RANDOM,
    "random": Source.RANDOM,
    "getrandom": Source.RANDOM,
    "getentropy": Source.RANDOM,
    "arc4random": Source.RANDOM,
    "drand48": Source.RANDOM,
    "lrand48": Source.RANDOM,
    "times": Source.CLOCK,
    "getrusage": Source.CLOCK,
    "getpid": Source.PID,
    "getppid": Source.ENVIRONMENT,
    "gettid": Source.ENVIRONMENT,
    "getenv": Source.ENVIRONMENT,
    "gethostname": Source.ENVIRONMENT,
    "sched_getcpu": Source.ENVIRONMENT,
}
"""Functions of the C library that nodes call through ctypes or cffi."""

_is_hooked = False


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    """Take an audit event: hundreds of kinds, of which few matter."""
    handle = _HANDLERS.get(event)
    guard = engaged() if handle is not None else None
    if handle is None or guard is None:
        return
    frame: Any = caller()
    if event in _ADDRESSES:
        if not guard.is_user(frame):
            return  # libraries use id() for bookkeeping
    elif user_frame(frame, guard.packages) is None:
        return
    with engage(None):  # what a finding costs is no finding
        wanted = handle(arguments, frame)
    if wanted is not None:
        source, call, value = wanted
        if event == "subprocess.Popen" and guard.mode(source, frame) is Mode.RECORD:
            return  # starting it is recorded, or else is a finding of its own
        guard.watched(source, call, value, frame)


_Wanted = tuple[Source, str, object] | None


def _opened(arguments: tuple[Any, ...], frame: FrameType) -> _Wanted:
    path, mode, flags = arguments
    if isinstance(path, int) or asking_module(frame) in READERS_OF_CODE:
        return None
    name = os.fsdecode(path)
    if name in ("/dev/urandom", "/dev/random"):
        return Source.RANDOM, f"open({name!r})", ""
    if is_installed(name):
        return None
    writing = any(c in mode for c in "wax+") if isinstance(mode, str) else flags & _WRITING
    if writing:
        return Source.FILE, f"open({name!r}, {mode or 'w'!r})", "written"
    return Source.FILE, f"open({name!r})", _content(name)


def _content(name: str) -> str:
    """Say what is in a file, in few characters."""
    try:
        size = os.stat(name).st_size
        if not os.path.isfile(name):
            return "no plain file"
        if size > _HASHED_BYTES_MAX:
            return f"{size} bytes"
        with open(name, "rb") as file:
            return f"{size} bytes, SHA-256 {hashlib.sha256(file.read()).hexdigest()[:16]}"
    except OSError as error:
        return error.strerror or type(error).__name__


def _foreign_function(arguments: tuple[Any, ...], frame: FrameType) -> _Wanted:
    name = str(arguments[1])
    source = FOREIGN.get(name)
    return None if source is None else (source, f"C library: {name}()", "")


def _one(source: Source, name: str) -> Callable[[tuple[Any, ...], FrameType], _Wanted]:
    def wanted(arguments: tuple[Any, ...], frame: FrameType) -> _Wanted:
        shown = next((a for a in arguments if isinstance(a, (str, bytes, list, tuple))), "")
        return source, f"{name}()", str(shown)[:200]

    return wanted


_HANDLERS: dict[str, Callable[[tuple[Any, ...], FrameType], _Wanted]] = {
    "open": _opened,
    "ctypes.dlsym": _foreign_function,
    "ctypes.addressof": lambda arguments, frame: (Source.ADDRESS, "ctypes.addressof()", ""),
    "builtins.id": lambda arguments, frame: (Source.ADDRESS, "id()", hex(arguments[0])),
    **{event: _one(Source.PROCESS, name) for event, name in _PROCESSES.items()},
    **{event: _one(Source.SOCKET, event) for event in _SOCKETS},
}


def report_audit_events() -> None:
    """Report what the audit hooks tell of from now on, while a guard is in charge."""
    global _is_hooked
    if not _is_hooked:
        sys.addaudithook(_hook)
        _is_hooked = True
