"""Finding the calls whose answers the run cannot make: files, processes, sockets, addresses, ….

Python's audit hooks report most of them. A hook cannot be taken back, so there is one per process,
which does nothing while no guard is in charge. Built-in functions without an audit event are
redirected.
"""

from __future__ import annotations

import _thread
import gc
import hashlib
import os
import re
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import BuiltinFunctionType, FrameType
from typing import Any

from rsltrace.guard.callers import user_frame
from rsltrace.guard.guard import Guard, engage, engaged
from rsltrace.guard.redirect import Redirected, copy_of
from rsltrace.guard.virtual.environment import environment_watched
from rsltrace.model.finding import Mode, Source

_HASHED_BYTES_MAX = 64 << 20
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_INSTALLED = (
    os.path.join(sys.prefix, ""),
    os.path.join(sys.base_prefix, ""),
    "/usr/share/zoneinfo/",
    "/usr/lib/",
    "/etc/mime.types",
    "/dev/null",
    "/dev/tty",
)
_READERS_OF_CODE = {"linecache", "tokenize", "inspect", "traceback", "zipimport", "pkgutil"}

_NOT_NEWS = {"logging", "threading", *_READERS_OF_CODE}
"""Modules that look at such things for records of their own."""

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
_FOREIGN = {
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
    "getpid": Source.ENVIRONMENT,
    "getppid": Source.ENVIRONMENT,
    "gettid": Source.ENVIRONMENT,
    "getenv": Source.ENVIRONMENT,
    "gethostname": Source.ENVIRONMENT,
    "sched_getcpu": Source.ENVIRONMENT,
}
"""Functions of the C library that nodes call through ctypes."""

_SQL = re.compile(
    r"'now'|\bCURRENT_(?:TIME|DATE|TIMESTAMP)\b|\b(?:julianday|unixepoch|date|time|datetime)\(\s*\)"
    r"|\brandom(?:blob)?\(",
    re.IGNORECASE,
)

_hooked = False


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    """Take an audit event: hundreds of kinds, of which few matter."""
    handle = _HANDLERS.get(event)
    if handle is not None:
        guard = engaged()
        if guard is not None:
            frame: Any = sys._getframe(1)
            with engage(None):  # what a finding costs is no finding
                wanted = handle(arguments, frame)
            if wanted is not None:
                source, call, value = wanted
                if event == "subprocess.Popen" and guard.mode(source, frame) is Mode.RECORD:
                    return  # starting it is recorded, or else is a finding of its own
                if source is Source.ADDRESS and not guard.is_user(frame):
                    return  # libraries use id() for bookkeeping
                guard.watched(source, call, value, frame)


_Wanted = tuple[Source, str, object] | None


def _opened(arguments: tuple[Any, ...], frame: FrameType) -> _Wanted:
    path, mode, flags = arguments
    if isinstance(path, int) or frame.f_globals.get("__name__") in _READERS_OF_CODE:
        return None
    name = os.fsdecode(path)
    if name in ("/dev/urandom", "/dev/random"):
        return Source.RANDOM, f"open({name!r})", ""
    if _is_installed(name):
        return None
    writing = any(c in mode for c in "wax+") if isinstance(mode, str) else flags & _WRITING
    if writing:
        return Source.FILE, f"open({name!r}, {mode or 'w'!r})", "written"
    return Source.FILE, f"open({name!r})", _content(name)


def _is_installed(path: object) -> bool:
    """Return whether a file is part of what is installed, whose versions a trace knows."""
    if not isinstance(path, (str, bytes, os.PathLike)):
        return False
    with engage(None):  # the working directory that is asked for is no finding
        return os.path.abspath(os.fsdecode(path)).startswith(_INSTALLED)


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
    source = _FOREIGN.get(name)
    return None if source is None else (source, f"C library: {name}()", "")


def _connecting(real: Callable[..., Any]) -> Any:
    def connect(*arguments: Any, **options: Any) -> Any:
        connection = real(*arguments, **options)
        if engaged() is not None:
            connection.set_trace_callback(_statement)
        return connection

    return connect


def _statement(sql: str) -> None:
    match = _SQL.search(sql)
    guard = engaged() if match is not None else None
    if guard is not None and match is not None:
        chance = match.group().lower().startswith("random")
        source = Source.RANDOM if chance else Source.CLOCK
        guard.watched(source, f"SQLite: {match.group()}", sql[:200], sys._getframe(1))


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


def _watching(source: Source, name: str, real: Callable[..., Any]) -> Any:
    def call(*arguments: Any, **options: Any) -> Any:
        guard = engaged()
        if guard is None:
            return real(*arguments, **options)
        frame = sys._getframe(1)
        if source is not Source.THREAD and frame.f_globals.get("__name__") in _NOT_NEWS:
            return real(*arguments, **options)
        shown = ""
        if source is Source.FILE:
            if _is_installed(arguments[0] if arguments else options.get("path")):
                return real(*arguments, **options)
            shown = ", ".join(map(repr, arguments))[:100]
        said = f"{name}({shown})"
        made_of = _RECORDED.get(name)
        if (
            made_of is not None
            and guard.mode(source, frame) is Mode.RECORD
            and user_frame(frame, guard.packages) is not None
        ):
            return made_of(guard.recorded(source, said, lambda: real(*arguments, **options), frame))
        value = real(*arguments, **options)
        guard.watched(source, said, _told(value), frame)
        return value

    return call


def _told(value: Any) -> str:
    if hasattr(value, "st_mtime_ns"):
        return f"{value.st_size} bytes, changed {value.st_mtime_ns}"
    return f"{len(value)} elements" if isinstance(value, list) else repr(value)[:200]


def _as_it_is(value: Any) -> Any:
    return value


_RECORDED: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys(
        (
            *("os.getpid", "os.getppid", "os.cpu_count", "os.getcwd", "os.sysconf"),
            *("os.getlogin", "os.getloadavg", "thread.get_native_id", "gc.get_count"),
        ),
        _as_it_is,
    ),
    "os.uname": os.uname_result,
    "os.times": os.times_result,
    "resource.getrusage": resource.struct_rusage,
}
"""What makes of a recorded answer what the function gives."""


def _hashing(real: Callable[[Any], int]) -> Any:
    def hash_of(thing: Any, /) -> int:
        value = real(thing)
        if is_by_address(thing):
            guard = engaged()
            frame = sys._getframe(1)
            if guard is not None and guard.is_user(frame):
                kind = type(thing).__qualname__
                guard.watched(Source.ADDRESS, f"hash() of {kind}", value, frame)
        return value

    return hash_of


_ALIKE = object.__hash__
_SEEDED = os.environ.get("PYTHONHASHSEED", "random") == "random"


def is_by_address(thing: object) -> bool:
    """Return whether an object's hash differs from process to process."""
    kind = type(thing)
    if kind in (int, float, bool, complex):
        return False
    if kind in (str, bytes):
        return _SEEDED
    if kind in (tuple, frozenset):
        return any(map(is_by_address, thing))  # type: ignore[call-overload]
    if thing is None:
        return sys.version_info < (3, 12)
    return getattr(kind, "__hash__", None) is _ALIKE


def _watched_functions() -> Iterator[tuple[Source, str, Any]]:
    def builtin(module: Any, *names: str) -> Iterator[tuple[str, Any]]:
        for name in names:
            function = getattr(module, name, None)
            if isinstance(function, BuiltinFunctionType):
                yield f"{module.__name__}.{name}".lstrip("_"), function

    for name, function in builtin(os, "times"):
        yield Source.CLOCK, name, function
    machine = (
        *("getpid", "getppid", "uname", "cpu_count", "getcwd", "getlogin", "getloadavg"),
        *("sysconf", "getpgid", "getsid"),
    )
    for name, function in builtin(os, *machine):
        yield Source.ENVIRONMENT, name, function
    for name, function in builtin(gc, "get_stats", "get_count", "get_objects"):
        yield Source.ENVIRONMENT, name, function
    for name, function in builtin(sys, "getallocatedblocks"):
        yield Source.ENVIRONMENT, name, function
    for name, function in builtin(os, "stat", "lstat", "statvfs", "fstatvfs"):
        yield Source.FILE, name, function
    for name, function in builtin(_thread, "start_new_thread", "start_joinable_thread"):
        yield Source.THREAD, name, function
    for name, function in builtin(_thread, "get_native_id"):
        yield Source.ENVIRONMENT, name, function
    for name, function in builtin(signal, "alarm", "setitimer"):
        yield Source.THREAD, name, function
    for name, function in builtin(resource, "getrusage"):
        yield Source.CLOCK, name, function
    if "_ssl" in sys.modules:
        for name, function in builtin(sys.modules["_ssl"], "RAND_bytes"):
            yield Source.RANDOM, name, function


@contextmanager
def watching() -> Iterator[None]:
    """Watch for calls that cannot be made deterministic."""
    global _hooked
    if not _hooked:
        sys.addaudithook(_hook)
        _hooked = True
    with ExitStack() as stack:
        for source, name, function in list(_watched_functions()):
            watched = _watching(source, name, copy_of(function))
            stack.callback(Redirected(function, watched).restore)
        import sqlite3  # a node may import it at any time; then it must be watched already

        database: Any = sqlite3.connect
        stack.callback(Redirected(database, _connecting(copy_of(database))).restore)
        stack.callback(Redirected(hash, _hashing(copy_of(hash))).restore)  # type: ignore[arg-type]
        stack.enter_context(environment_watched())
        yield


def text_with_address(text: str) -> None:
    """Report a text for others to see in which an object's address stands."""
    guard = engaged()
    if guard is not None:
        match = _ADDRESS.search(text)
        if match is not None:
            report_here(guard, Source.ADDRESS, "an address in a log record", match.group())


def report_here(guard: Guard, source: Source, call: str, value: str) -> None:
    """Report something that user code did through our own middleware."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if guard.is_user(frame):
            guard.watched(source, call, value, frame)
            return
        frame = frame.f_back


_ADDRESS = re.compile(r"\S* at 0x[0-9a-f]{6,}")
