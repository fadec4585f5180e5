"""Calls whose answers the run cannot make: reported, and recorded where the job says so.

Python's audit hooks report most of them; built-in functions without an audit event are redirected.
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
from functools import partial
from types import BuiltinFunctionType, FrameType
from typing import Any

from rsltrace.guard.callers import is_of_python, module_of
from rsltrace.guard.file_report_filter import NOT_NEWS, asking_module, is_installed
from rsltrace.guard.frames import caller, code_of
from rsltrace.guard.guard import Guard, engaged
from rsltrace.guard.libraries import is_library
from rsltrace.guard.redirect import redirect
from rsltrace.guard.watched.audit_hook import report_audit_events
from rsltrace.trace.model.finding import READ_BY, Mode, Source

# Reads of ``os.environ``: found, or recorded and given again.
#
# ``os.environ`` is an object of a Python class. For the time of a run it gets a class derived from
# that one. Its own class is left alone: methods that are set on a class again and again (twice per
# run) cost it its place in the interpreter's caches, and Python 3.13 then goes on to call the
# ``__getitem__`` that it has cached, whatever the class says.

_NOT_READ = ("PYTHON", "ROS_PYTHON_", "ROS_VERSION")
"""What Python looks at for itself, what every class of messages does when it is imported, and what
is the same wherever there is ROS 2."""

_LAYS_OUT = {"os", "_collections_abc", "collections.abc", "shutil", "locale", "gettext", "argparse"}

_SECRET = re.compile("key|token|secret|pass|credential|auth", re.IGNORECASE)

_Environ: Any = type(os.environ)


class _Watched(_Environ):  # type: ignore[misc]
    """The environment while a run watches it."""

    def __getitem__(self, name: str) -> str:
        guard = _guard_of(self, name)
        if guard is None:
            return str(super().__getitem__(name))
        frame = caller()
        call = f"os.environ[{name!r}]"
        if guard.mode(Source.ENVIRONMENT, frame) is Mode.RECORD and guard.is_for_user(frame):
            kept = guard.recorded(
                Source.ENVIRONMENT, call, lambda: self._data.get(self.encodekey(name)), frame
            )
            if kept is None:
                raise KeyError(name)
            return str(self.decodevalue(kept))
        try:
            value = str(super().__getitem__(name))
        except KeyError:
            guard.watched(Source.ENVIRONMENT, call + _reader(frame), "not set", frame)
            raise
        guard.watched(Source.ENVIRONMENT, call + _reader(frame), _shown(name, value), frame)
        return value

    def __iter__(self) -> Iterator[str]:
        guard = _guard_of(self)
        if guard is not None:
            frame = caller()
            call = "os.environ" + _reader(frame)
            guard.watched(Source.ENVIRONMENT, call, f"{len(self)} variables", frame)
        names: Iterator[str] = super().__iter__()
        return names


def _guard_of(environment: object, name: str = "") -> Guard | None:
    """Return the guard in charge if the read of who calls this is one to tell it of."""
    guard = engaged()
    if guard is None or environment is not os.environ or str(name).startswith(_NOT_READ):
        return None
    return None if _lays_out_help(sys._getframe(2)) else guard


@contextmanager
def environment_watched() -> Iterator[None]:
    """Report reads of ``os.environ``."""
    environment: Any = os.environ
    kind = type(environment)
    environment.__class__ = _Watched
    try:
        yield
    finally:
        environment.__class__ = kind


def _lays_out_help(frame: FrameType | None) -> bool:
    """Whether argparse wants the terminal's width and language, which no node looks at."""
    while frame is not None and (module := module_of(frame)) in _LAYS_OUT:
        if module == "argparse":
            return True
        frame = frame.f_back
    return False


def _reader(frame: FrameType | None) -> str:
    """Name the library that reads a variable, if the node itself does not."""
    while frame is not None and is_of_python(frame):
        frame = frame.f_back
    if frame is None or not is_library(code_of(frame).co_filename):
        return ""
    return f"{READ_BY}{module_of(frame).partition('.')[0]}"


def _shown(name: str, value: str) -> str:
    """Return a variable's value as evidence; of one that may be a secret, only a hash."""
    if _SECRET.search(name) or len(value) > 200:
        return f"SHA-256 {hashlib.sha256(os.fsencode(value)).hexdigest()[:16]}"
    return repr(value)


_SQL = re.compile(
    r"'now'|\bCURRENT_(?:TIME|DATE|TIMESTAMP)\b|\b(?:julianday|unixepoch|date|time|datetime)\(\s*\)"
    r"|\brandom(?:blob)?\(",
    re.IGNORECASE,
)


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
        guard.watched(source, f"SQLite: {match.group()}", sql[:200], caller())


def _watching(source: Source, name: str, real: Callable[..., Any]) -> Any:
    made_of = _RECORDED.get(name)
    is_thread, is_file = source is Source.THREAD, source is Source.FILE

    def call(*arguments: Any, **options: Any) -> Any:
        guard = engaged()
        if guard is None:
            return real(*arguments, **options)
        frame = caller()
        if not guard.is_for_user(frame):
            return real(*arguments, **options)  # ROS and Python, for themselves
        if not is_thread and asking_module(frame) in NOT_NEWS:
            return real(*arguments, **options)
        shown = ""
        if is_file:
            if is_installed(arguments[0] if arguments else options.get("path")):
                return real(*arguments, **options)
            shown = ", ".join(map(repr, arguments))[:100]
        said = f"{name}({shown})"
        if made_of is not None and guard.mode(source, frame) is Mode.RECORD:
            return made_of(guard.recorded(source, said, lambda: real(*arguments, **options), frame))
        value = real(*arguments, **options)
        guard.watched(source, said, value, frame, _told)
        return value

    return call


def _told(value: Any) -> str:
    return f"{len(value)} elements" if isinstance(value, list) else repr(value)[:200]


def _as_it_is(value: Any) -> Any:
    return value


_RECORDED: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys(
        (
            *("os.getppid", "os.getcwd", "os.sysconf"),
            *("os.getlogin", "os.getloadavg", "thread.get_native_id", "gc.get_count"),
        ),
        _as_it_is,
    ),
    "os.uname": os.uname_result,
    "os.times": os.times_result,
    "resource.getrusage": resource.struct_rusage,
}
"""What makes of a recorded answer what the function gives."""


def _watched_functions() -> Iterator[tuple[Source, str, Any]]:
    def builtin(module: Any, *names: str) -> Iterator[tuple[str, Any]]:
        for name in names:
            function = getattr(module, name, None)
            if isinstance(function, BuiltinFunctionType):
                yield f"{module.__name__}.{name}".lstrip("_"), function

    for name, function in builtin(os, "times"):
        yield Source.CLOCK, name, function
    machine = (
        *("getppid", "uname", "getcwd", "getlogin", "getloadavg"),
        *("sysconf", "getpgid", "getsid"),
    )
    for name, function in builtin(os, *machine):
        yield Source.ENVIRONMENT, name, function
    for name, function in builtin(gc, "get_stats", "get_count", "get_objects"):
        yield Source.ENVIRONMENT, name, function
    for name, function in builtin(sys, "getallocatedblocks"):
        yield Source.ENVIRONMENT, name, function
    for name, function in builtin(os, "statvfs", "fstatvfs"):
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
def watched_calls() -> Iterator[None]:
    """Report calls that cannot be made deterministic."""
    report_audit_events()
    with ExitStack() as stack:
        for source, name, function in list(_watched_functions()):
            redirect(stack, function, partial(_watching, source, name))
        import sqlite3  # a node may import it at any time; then it must be watched already

        redirect(stack, sqlite3.connect, _connecting)
        stack.enter_context(environment_watched())
        yield
