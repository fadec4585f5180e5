"""Calls that the guard reports, and records or answers where ``rules.RULES`` and the job say so.

Python's audit hooks report files, processes, sockets, addresses and the C library. A run replaces
functions that have no audit event, and the class of ``os.environ``.
"""

from __future__ import annotations

import hashlib
import os
import sys
import urllib.parse
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import FrameType
from typing import Any

from rsltrace.guard.addresses import was_passed
from rsltrace.guard.callers import is_python_frame, module_of, user_frame
from rsltrace.guard.frames import caller, code_of, replace_member
from rsltrace.guard.guard import Guard, engage, engaged
from rsltrace.guard.libraries import TARGETS, is_library
from rsltrace.guard.loading import when_loaded
from rsltrace.guard.redirect import redirect, redirect_function
from rsltrace.guard.rules import (
    AUDIT_EVENTS,
    C_FUNCTIONS,
    REPORTED_MEMBERS,
    RULES,
    Rule,
    answers,
    sql_call,
)
from rsltrace.trace.model.finding import READ_BY, GuardMode, NondeterminismSource
from rsltrace.trace.model.texts import variable_text

_INSTALLED = (
    os.path.join(sys.prefix, ""),
    os.path.join(sys.base_prefix, ""),
    "/usr/share/zoneinfo/",
    "/usr/lib/",
    "/etc/mime.types",
    "/dev/null",
    "/dev/tty",
    *TARGETS,
)
SOURCE_READERS = {"linecache", "tokenize", "inspect", "traceback", "zipimport", "pkgutil"}
_COMPILED = "/__pycache__/"
_BETWEEN = ("genericpath", "posixpath", "rsltrace.guard.recorded.files")
"""Modules through which others access the file system."""

_METADATA_READERS = ("importlib.metadata", "importlib_metadata")
UNREPORTED_MODULES = frozenset((*_METADATA_READERS, "logging", "threading", *SOURCE_READERS))
"""Modules that access files and the machine for their own records."""


def calling_module(frame: FrameType) -> str | None:
    """Return the name of the module that accesses the file system, skipping ``os.path``."""
    name = frame.f_globals.get("__name__")
    while name in _BETWEEN and frame.f_back is not None:
        frame = frame.f_back
        name = frame.f_globals.get("__name__")
    return name


def is_following_links(frame: FrameType) -> bool:
    """Return whether a path's links are being followed; folders on the way do not count."""
    is_of_python = frame.f_globals.get("__name__") == "posixpath"
    return is_of_python and code_of(frame).co_name in ("realpath", "_joinrealpath")


def is_installed_path(path: object) -> bool:
    """Return whether a file is installed (the trace has its version) or compiled from source beside
    it."""
    if not isinstance(path, (str, bytes, os.PathLike)):
        return False
    name = os.fsdecode(path)
    if not name.startswith(os.sep):
        with engage(None):  # the working directory that is asked for is no finding
            name = os.path.abspath(name)
    elif "/." in name or "//" in name:
        name = os.path.abspath(name)
    return name.startswith(_INSTALLED) or _COMPILED in f"{name}/"


# -- functions that are replaced ------------------------------------------------------------------

REPORTED_MODULES = frozenset(
    name.rpartition(".")[0] for name, rule in RULES.items() if rule.reports is not None
)
"""Modules with such functions."""


def report_functions(stack: ExitStack, module: str) -> None:
    """Replace the functions of a loaded module that have a rule, until ``stack`` ends."""
    for name, rule in RULES.items():
        owner, _, attribute = name.rpartition(".")
        if owner == module and rule.reports is not None:
            redirect_function(
                stack, sys.modules[module], attribute, partial(_reporting, name, rule)
            )


def _reporting(name: str, rule: Rule, real: Callable[..., Any]) -> Any:
    source, restore, answer = rule.reports, rule.restore, rule.answer
    assert source is not None
    name = name.lstrip("_")
    is_thread, is_file = source is NondeterminismSource.THREAD, source is NondeterminismSource.FILE

    def call(*arguments: Any, **options: Any) -> Any:
        guard = engaged()
        if guard is None:
            return real(*arguments, **options)
        frame = caller()
        if not guard.is_user_call(frame):
            return real(*arguments, **options)  # ROS and Python, for themselves
        if answer is not None and answers(source, guard.mode(source, frame)):
            guard.count_call(source, f"{name}()", frame)
            return answer(*arguments, **options)
        if not is_thread and calling_module(frame) in UNREPORTED_MODULES:
            return real(*arguments, **options)
        shown = ""
        if is_file:
            path = arguments[0] if arguments else options.get("path")
            if is_installed_path(path) or is_following_links(frame):
                return real(*arguments, **options)
            shown = ", ".join(map(repr, arguments))[:100]
        text = f"{name}({shown})"
        if restore is not None and guard.mode(source, frame) is GuardMode.RECORD:
            return restore(guard.record(source, text, lambda: real(*arguments, **options), frame))
        value = real(*arguments, **options)
        guard.report_user_call(source, text, value, frame, _value_text)
        return value

    return call


def _report_member(stack: ExitStack, name: str, source: NondeterminismSource) -> None:
    """Replace a method or property of a type of a loaded module until ``stack`` ends."""
    module, owner, member = name.rsplit(".", 2)
    kind = getattr(sys.modules.get(module), owner, None)
    if kind is None:
        return
    make = partial(_reporting_member, f"{owner}.{member}", source)
    if member in kind.__dict__:
        replace_member(stack, kind, member, make)
    else:  # inherited from a type that is left alone
        setattr(kind, member, make(getattr(kind, member)))
        stack.callback(delattr, kind, member)


def _reporting_member(name: str, source: NondeterminismSource, real: Any) -> Any:
    def report(value: Any) -> Any:
        guard = engaged()
        if guard is not None:
            frame: Any = sys._getframe(2)
            of_code = source is not NondeterminismSource.ADDRESS  # which libraries use, too
            if guard.is_user(frame) or (of_code and guard.is_user_call(frame)):
                guard.report_user_call(source, name, value, frame, _value_text)
        return value

    if callable(real):

        def call(self: Any, *arguments: Any, **options: Any) -> Any:
            return report(real(self, *arguments, **options))

        return call

    def get(self: Any) -> Any:
        return report(real.__get__(self))

    return property(get, getattr(real, "__set__", None))


def _value_text(value: Any) -> str:
    return f"{len(value)} elements" if isinstance(value, list) else repr(value)[:200]


def _connecting(real: Callable[..., Any]) -> Any:
    def connect(*arguments: Any, **options: Any) -> Any:
        connection = real(*arguments, **options)
        if engaged() is not None:
            connection.set_trace_callback(_report_statement)
        return connection

    return connect


def _report_connections(stack: ExitStack) -> None:
    redirect(stack, sys.modules["_sqlite3"].connect, _connecting)


def _report_statement(sql: str) -> None:
    found = sql_call(sql)
    guard = engaged() if found is not None else None
    if guard is not None and found is not None and found[1].source is not None:
        guard.report_user_call(found[1].source, found[0], sql[:200], caller())


# -- reads of os.environ --------------------------------------------------------------------------
#
# For the time of a run, ``os.environ`` gets a class derived from its own. Its own class is left
# alone: methods that are set on a class twice per run cost it its place in the interpreter's
# caches, and Python 3.13 then calls the cached ``__getitem__``.

_NOT_READ = ("PYTHON", "ROS_PYTHON_", "ROS_VERSION")
"""Variables that Python itself reads, that every message class reads when imported, and that are
the same wherever ROS 2 is."""

_HELP_MODULES = {
    "os",
    "_collections_abc",
    "collections.abc",
    "shutil",
    "locale",
    "gettext",
    "argparse",
}


_Environ: Any = type(os.environ)


class _ReportedEnvironment(_Environ):  # type: ignore[misc]
    """``os.environ`` and ``os.environb`` during a run."""

    def __getitem__(self, name: Any) -> Any:
        guard = _guard_of(self, name)
        if guard is None:
            return super().__getitem__(name)
        frame = caller()
        call = f"os.environ[{name!r}]"
        if guard.mode(
            NondeterminismSource.ENVIRONMENT, frame
        ) is GuardMode.RECORD and guard.is_user_call(frame):
            kept = guard.record(
                NondeterminismSource.ENVIRONMENT,
                call,
                lambda: self._data.get(self.encodekey(name)),
                frame,
            )
            if kept is None:
                raise KeyError(name)
            return self.decodevalue(kept)
        try:
            value = super().__getitem__(name)
        except KeyError:
            guard.report_user_call(
                NondeterminismSource.ENVIRONMENT, call + _reader(frame), "not set", frame
            )
            raise
        guard.report_user_call(
            NondeterminismSource.ENVIRONMENT,
            call + _reader(frame),
            variable_text(name, value),
            frame,
        )
        return value

    def __iter__(self) -> Iterator[str]:
        self._report_all(caller())
        names: Iterator[str] = super().__iter__()
        return names

    def __len__(self) -> int:
        self._report_all(caller())
        return len(self._data)

    def __repr__(self) -> str:
        self._report_all(caller())
        return str(super().__repr__())

    def _report_all(self, frame: FrameType) -> None:
        guard = _guard_of(self, depth=3)
        if guard is not None:
            call, count = "os.environ" + _reader(frame), f"{len(self._data)} variables"
            guard.report_user_call(NondeterminismSource.ENVIRONMENT, call, count, frame)


def _guard_of(environment: object, name: Any = "", depth: int = 2) -> Guard | None:
    """Return the engaged guard if a read, ``depth`` frames up, is to be reported."""
    guard = engaged()
    if guard is None or not (environment is os.environ or environment is os.environb):
        return None
    if isinstance(name, (str, bytes)) and os.fsdecode(name).startswith(_NOT_READ):
        return None
    return None if _is_formatting_help(sys._getframe(depth)) else guard


@contextmanager
def environment_watched() -> Iterator[None]:
    """Report reads of ``os.environ``."""
    environments: tuple[Any, ...] = (os.environ, os.environb)
    for environment in environments:
        environment.__class__ = _ReportedEnvironment
    try:
        yield
    finally:
        for environment in environments:
            environment.__class__ = _Environ


def _is_formatting_help(frame: FrameType | None) -> bool:
    """Whether argparse reads the terminal's width and language, which no node uses."""
    while frame is not None and (module := module_of(frame)) in _HELP_MODULES:
        if module == "argparse":
            return True
        frame = frame.f_back
    return False


def _reader(frame: FrameType | None) -> str:
    """Return which library reads a variable, if not the node itself."""
    while frame is not None and is_python_frame(frame):
        frame = frame.f_back
    if frame is None or not is_library(code_of(frame).co_filename):
        return ""
    return f"{READ_BY}{module_of(frame).partition('.')[0]}"


# -- audit events ---------------------------------------------------------------------------------
#
# A hook cannot be removed, so a process has one, which does nothing while no guard is engaged.

_HASHED_BYTES_MAX = 64 << 20
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_ADDRESSES = ("ctypes.addressof", "builtins.id")
_SHOWING = ("__repr__", "__lt__")
"""Methods that let addresses be seen, in texts and in the order of what is sorted (``pprint``)."""
_is_hooked = False


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    """Take an audit event: of hundreds of kinds, few matter."""
    if event not in _HANDLERS or (guard := engaged()) is None:
        return
    handle = _HANDLERS[event]
    frame: Any = caller()
    if event in _ADDRESSES:
        shows = code_of(frame).co_name in _SHOWING or was_passed(event.partition(".")[2], frame)
        if not (shows or guard.is_user(frame)):
            return  # libraries use id() for bookkeeping
    elif user_frame(frame, guard.packages) is None:
        return
    with engage(None):  # what a finding costs is no finding
        wanted = handle(arguments, frame)
    if wanted is not None:
        source, call, value = wanted
        if event == "subprocess.Popen" and guard.mode(source, frame) is GuardMode.RECORD:
            return  # starting it is recorded, or else is a finding of its own
        guard.report_user_call(source, call, value, frame)


_Report = tuple[NondeterminismSource, str, object] | None
_SOURCES = (".py", ".pyc", ".zip", ".egg", ".pyz")


def _open_report(arguments: tuple[Any, ...], frame: FrameType) -> _Report:
    path, mode, flags = arguments
    if isinstance(path, int):
        return None
    name = os.fsdecode(path)
    if name.endswith(_SOURCES) and calling_module(frame) in SOURCE_READERS:
        return None
    if name in ("/dev/urandom", "/dev/random"):
        return NondeterminismSource.RANDOM, f"open({name!r})", ""
    if is_installed_path(name):
        return None
    writing = any(c in mode for c in "wax+") if isinstance(mode, str) else flags & _WRITING
    if writing:
        return NondeterminismSource.FILE, f"open({name!r}, {mode or 'w'!r})", "written"
    if name[:1] + name[-1:] == "<>" and not os.path.exists(name):
        return None  # code that is in no file: Python looks there for the line of a syntax error
    return NondeterminismSource.FILE, f"open({name!r})", _content(name)


def _content(name: str) -> str:
    """Describe the content of a file in few characters."""
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


def _database_report(arguments: tuple[Any, ...], frame: FrameType) -> _Report:
    name = os.fsdecode(arguments[0])
    if not name or ":memory:" in name or "mode=memory" in name:
        return None
    file = urllib.parse.unquote(name[5:].partition("?")[0]) if name.startswith("file:") else name
    # Closing a file drops the locks that other connections of this process hold on it.
    in_use = any(os.path.exists(f"{file}{end}") for end in ("-journal", "-wal"))
    value = "in use" if in_use else _content(file)
    return NondeterminismSource.FILE, f"sqlite3.connect({file!r})", value


def _foreign_function(arguments: tuple[Any, ...], frame: FrameType) -> _Report:
    name = str(arguments[1])
    source = C_FUNCTIONS.get(name)
    return None if source is None else (source, f"C library: {name}()", "")


def _event_report(
    source: NondeterminismSource, name: str
) -> Callable[[tuple[Any, ...], FrameType], _Report]:
    def wanted(arguments: tuple[Any, ...], frame: FrameType) -> _Report:
        shown = next((a for a in arguments if isinstance(a, (str, bytes, list, tuple))), "")
        return source, f"{name}()", str(shown)[:200]

    return wanted


_HANDLERS: dict[str, Callable[[tuple[Any, ...], FrameType], _Report]] = {
    "open": _open_report,
    "sqlite3.connect": _database_report,
    "ctypes.dlsym": _foreign_function,
    "ctypes.addressof": lambda arguments, frame: (
        NondeterminismSource.ADDRESS,
        "ctypes.addressof()",
        "",
    ),
    "builtins.id": lambda arguments, frame: (
        NondeterminismSource.ADDRESS,
        "id()",
        hex(arguments[0]),
    ),
    **{event: _event_report(source, event) for event, source in AUDIT_EVENTS.items()},
}


def report_audit_events() -> None:
    """Report audit events from now on, while a guard is engaged."""
    global _is_hooked
    if not _is_hooked:
        sys.addaudithook(_hook)
        _is_hooked = True


@contextmanager
def reported_calls() -> Iterator[None]:
    """Report calls until the block ends."""
    report_audit_events()
    with ExitStack() as stack:
        for module in sorted(REPORTED_MODULES):
            when_loaded(stack, module, partial(report_functions, stack, module))
        for name, source in REPORTED_MEMBERS.items():
            module = name.rsplit(".", 2)[0]
            if module in sys.stdlib_module_names or module in sys.modules:  # numpy is by now
                when_loaded(stack, module, partial(_report_member, stack, name, source))
        when_loaded(stack, "_sqlite3", partial(_report_connections, stack))
        stack.enter_context(environment_watched())
        yield
