"""Calls whose answers the run cannot make: reported, and recorded where the job says so.

Python's audit hooks report most of them; built-in functions without an audit event are redirected.
"""

from __future__ import annotations

import _thread
import gc
import os
import re
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import BuiltinFunctionType
from typing import Any

from rsltrace.guard.asked_files import NOT_NEWS, asking_module, is_installed
from rsltrace.guard.frames import caller
from rsltrace.guard.guard import engaged
from rsltrace.guard.redirect import redirect
from rsltrace.guard.watched.audit_hook import report_audit_events
from rsltrace.guard.watched.environment import environment_watched
from rsltrace.trace.model.finding import Mode, Source

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
