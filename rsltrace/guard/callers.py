"""Whose call is it? The user's code is told from libraries, Python's own modules and ourselves."""

from __future__ import annotations

import os
import sysconfig
from functools import cache
from types import FrameType

from rsltrace.guard.libraries import is_library

_HERE = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep
_GUARD = os.path.join(_HERE, "guard", "")
_PYTHON = tuple(
    path.rstrip(os.sep) + os.sep
    for path in {sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib")}
)
_INSTALLED = (f"{os.sep}site-packages{os.sep}", f"{os.sep}dist-packages{os.sep}")
_MIDDLEWARE = ("rclpy", "rpyutils", "ament_index_python", "rosidl_parser", "rosidl_pycommon")
_LINES_MAX = 6

_USER, _STANDARD, _LIBRARY, _OURS, _IMPORT = range(5)
_DOOR = os.path.join(_HERE, "doors", "rclpy")
_CALLS_BACK = os.path.join(_HERE, "middleware", "events", "dispatcher.py")
"""The one of our files that calls callbacks; rclpy's own do, too."""
_THREADS = os.path.join(_DOOR, "stacks", "threads.py")
_STANDS_IN = (
    os.path.join(_DOOR, "stacks", "asyncio_loops.py"),
    os.path.join(_DOOR, "terminals", "calls.py"),
)
"""Parts of asyncio, os and select, as far as it matters who called whom."""
_kinds: dict[str, int] = {}


def _kind_of(file: str) -> int:
    kind = _kinds.get(file)
    if kind is None:
        if file.startswith("<frozen importlib"):
            kind = _IMPORT
        elif file.startswith(_GUARD) or file in _STANDS_IN:
            kind = _STANDARD  # a redirected function: its caller counts
        elif file.startswith(_HERE) or any(
            f"{installed}{name}{os.sep}" in file for installed in _INSTALLED for name in _MIDDLEWARE
        ):
            kind = _OURS  # rclpy, too: what it looks at is not the user's doing
        elif is_library(file):
            kind = _LIBRARY
        elif file.startswith(("<frozen", *_PYTHON)) and not any(p in file for p in _INSTALLED):
            kind = _STANDARD
        else:
            kind = _USER
        _kinds[file] = kind
    return kind


@cache
def is_installed(file: str) -> bool:
    """Whether a file lies among what is installed, be it a library's or the user's."""
    return any(part in file for part in _INSTALLED)


def _calls_back(file: str) -> bool:
    if file.startswith(_HERE):
        return file == _CALLS_BACK
    return f"{os.sep}rclpy{os.sep}" in file


def is_own(module: str) -> bool:
    """Return whether a module is rsltrace's, which may lie in a folder of user code."""
    return module.partition(".")[0] in ("rsltrace", "rsltrace_viewer")


def is_user_file(file: str) -> bool:
    """Return whether a source file is neither Python's nor a library's nor ours."""
    return _kind_of(file) == _USER


def is_telling(file: str) -> bool:
    """Return whether a source file is of the user's code or of what that uses: neither Python's,
    nor rclpy's, nor ours."""
    return _kind_of(file) in (_USER, _LIBRARY)


def is_of_python(frame: FrameType) -> bool:
    """Return whether a frame is one of Python's own modules (or of the guard)."""
    file = frame.f_code.co_filename
    kind = _kinds.get(file)
    return (_kind_of(file) if kind is None else kind) == _STANDARD


def is_nobodys(frame: FrameType | None) -> bool:
    """Return whether it is seen at once that ``user_frame`` is None: rclpy, rsltrace or an import
    asks, by way of Python's own modules at most."""
    while frame is not None:
        file = frame.f_code.co_filename
        kind = _kinds.get(file)
        if kind is None:
            kind = _kind_of(file)
        if kind != _STANDARD:
            return kind == _IMPORT or (kind == _OURS and file != _THREADS)
        frame = frame.f_back
    return False


def user_frame(frame: FrameType | None, packages: frozenset[str]) -> FrameType | None:
    """Return the innermost frame of user code that led to ``frame``, or None if none did.

    User code is what is neither Python's nor a library's, or in ``packages`` (where nodes are), and
    a callback in a library. What an installed package does while it is imported is not the user's
    doing, nor is what rsltrace and rclpy do for themselves. A thread is the doing of whoever
    started it, even if it runs nothing but Python's own code.
    """
    installed = library = standard = None
    while frame is not None:
        file = frame.f_code.co_filename
        kind = _kinds.get(file)
        if kind is None:
            kind = _kind_of(file)
        if kind == _OURS:  # at first: most calls of a run are rclpy's, for itself
            if file == _THREADS:
                return installed or library or standard
            return installed or (library if _calls_back(file) else None)
        if packages and is_in(frame, packages):
            return installed or frame
        if kind == _USER:
            if not is_installed(file):
                return installed or frame
            installed = installed or frame  # unless it is being imported
        elif kind == _LIBRARY:
            library = frame
        elif kind == _STANDARD:
            standard = frame
        elif kind == _IMPORT:
            return None
        frame = frame.f_back
    return installed


def in_import(frame: FrameType | None, packages: frozenset[str]) -> bool:
    """Return whether something that is installed is being imported, rather than user code run."""
    while frame is not None:
        file = frame.f_code.co_filename
        kind = _kind_of(file)
        if kind == _OURS or (kind == _USER and not is_installed(file)):
            return False
        if packages and is_in(frame, packages):
            return False
        if kind == _IMPORT:
            return True
        frame = frame.f_back
    return False


def is_in(frame: FrameType, packages: frozenset[str]) -> bool:
    """Return whether a frame's module is in one of the packages."""
    return module_of(frame).partition(".")[0] in packages


def module_of(frame: FrameType) -> str:
    """Return the name of a frame's module."""
    return str(frame.f_globals.get("__name__", ""))


def stack_of(frame: FrameType | None, packages: frozenset[str]) -> str:
    """Return the lines of user code from ``frame`` outwards, without paths of this machine."""
    lines: list[str] = []
    while frame is not None and len(lines) < _LINES_MAX:
        kind = _kind_of(frame.f_code.co_filename)
        if kind == _USER or (packages and is_in(frame, packages)):
            code = frame.f_code
            folder = module_of(frame).rpartition(".")[0].replace(".", "/")
            file = os.path.basename(code.co_filename)
            place = f"{folder}/{file}" if folder else file
            name = getattr(code, "co_qualname", code.co_name)  # from Python 3.11 on
            lines.append(f"{place}:{frame.f_lineno} in {name}")
        elif kind == _OURS:
            break
        frame = frame.f_back
    return "\n".join(lines)
