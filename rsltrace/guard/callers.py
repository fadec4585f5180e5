"""Whose call is it? The user's code is told from libraries, Python's own modules and ourselves."""

from __future__ import annotations

import os
import sysconfig
from types import FrameType

from rsltrace.guard.frames import code_of
from rsltrace.guard.libraries import INSTALLED, is_library

_HERE = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep
_GUARD = os.path.join(_HERE, "guard", "")
_PYTHON = tuple(
    path.rstrip(os.sep) + os.sep
    for path in {sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib")}
)
_MIDDLEWARE = ("rclpy", "rpyutils", "ament_index_python", "rosidl_parser", "rosidl_pycommon")
_LINES_MAX = 6

USER, OURS, STANDARD, _PACKAGE, _LIBRARY, _IMPORT = range(6)
"""Whose a file is: the user's (a ``_PACKAGE`` is installed), Python's, a library's, rclpy's or
ours, or a part of importing."""

_DOOR = os.path.join(_HERE, "adapters", "rclpy")
_CALLS_BACK = os.path.join(_HERE, "simulation", "middleware", "events", "dispatcher.py")
"""The one of our files that calls callbacks; rclpy's own do, too."""
_THREADS = os.path.join(_DOOR, "stacks", "threads.py")
_STANDS_IN = (
    os.path.join(_DOOR, "stacks", "asyncio_loops.py"),
    os.path.join(_DOOR, "terminals", "calls.py"),
)
"""Parts of asyncio, os and select, as far as it matters who called whom."""


class _Kinds(dict[str, int]):
    """Whose files are, by name."""

    def __missing__(self, file: str) -> int:
        """Find out and remember it."""
        kind = self[file] = _kind_of(file)
        return kind


def _kind_of(file: str) -> int:
    if file.startswith("<frozen importlib"):
        return _IMPORT
    if file.startswith(_GUARD) or file in _STANDS_IN:
        return STANDARD  # a redirected function: its caller counts
    if file.startswith(_HERE) or any(
        f"{installed}{name}{os.sep}" in file for installed in INSTALLED for name in _MIDDLEWARE
    ):
        return OURS  # rclpy, too: what it looks at is not the user's doing
    if is_library(file):
        return _LIBRARY
    if is_installed(file):
        return _PACKAGE
    return STANDARD if file.startswith(("<frozen", *_PYTHON)) else USER


KINDS = _Kinds()
"""Whose each source file is; calls that are made often look here themselves."""


def is_installed(file: str) -> bool:
    """Whether a file lies among what is installed, be it a library's or the user's."""
    return any(part in file for part in INSTALLED)


def _calls_back(file: str) -> bool:
    if file.startswith(_HERE):
        return file == _CALLS_BACK
    return f"{os.sep}rclpy{os.sep}" in file


def is_own(module: str) -> bool:
    """Return whether a module is rsltrace's, which may lie in a folder of user code."""
    return module.partition(".")[0] in ("rsltrace", "rsltrace_viewer")


def is_user_file(file: str) -> bool:
    """Return whether a source file is neither Python's nor a library's nor ours."""
    return KINDS[file] in (USER, _PACKAGE)


def is_telling(file: str) -> bool:
    """Return whether a source file is of the user's code or of what that uses: neither Python's,
    nor rclpy's, nor ours."""
    return KINDS[file] in (USER, _PACKAGE, _LIBRARY)


def is_of_python(frame: FrameType) -> bool:
    """Return whether a frame is one of Python's own modules (or of the guard)."""
    return KINDS[code_of(frame).co_filename] == STANDARD


def is_nobodys(frame: FrameType | None) -> bool:
    """Return whether it is seen at once that ``user_frame`` is None: rclpy, rsltrace or an import
    asks, by way of Python's own modules at most."""
    while frame is not None:
        file = code_of(frame).co_filename
        kind = KINDS[file]
        if kind != STANDARD:
            return kind == _IMPORT or (kind == OURS and file != _THREADS)
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
        file = code_of(frame).co_filename
        kind = KINDS[file]
        if kind == USER:
            return installed or frame
        if kind == OURS:
            if file == _THREADS:
                return installed or library or standard
            return installed or (library and (library if _calls_back(file) else None))
        if packages and (_tops.get(file) or _top_of(frame, file)) in packages:
            return installed or frame
        if kind == _LIBRARY:
            library = frame
        elif kind == STANDARD:
            standard = frame
        elif kind == _PACKAGE:
            installed = installed or frame  # unless it is being imported
        else:
            return None
        frame = frame.f_back
    return installed


def in_import(frame: FrameType | None, packages: frozenset[str]) -> bool:
    """Return whether something that is installed is being imported, rather than user code run."""
    while frame is not None:
        kind = KINDS[code_of(frame).co_filename]
        if kind in (USER, OURS):
            return False
        if packages and is_in(frame, packages):
            return False
        if kind == _IMPORT:
            return True
        frame = frame.f_back
    return False


def is_in(frame: FrameType, packages: frozenset[str]) -> bool:
    """Return whether a frame's module is in one of the packages."""
    file = code_of(frame).co_filename
    top = _tops.get(file)
    return (_top_of(frame, file) if top is None else top) in packages


_tops: dict[str, str] = {}
"""The packages that files belong to."""


def _top_of(frame: FrameType, file: str) -> str:
    top = module_of(frame).partition(".")[0]
    if top != "__main__":  # a program in this run, perhaps a module in the next
        _tops[file] = top
    return top


def module_of(frame: FrameType) -> str:
    """Return the name of a frame's module."""
    return str(frame.f_globals.get("__name__", ""))


def stack_of(frame: FrameType | None, packages: frozenset[str]) -> str:
    """Return the lines of user code from ``frame`` outwards, without paths of this machine."""
    lines: list[str] = []
    while frame is not None and len(lines) < _LINES_MAX:
        kind = KINDS[code_of(frame).co_filename]
        if kind in (USER, _PACKAGE) or (packages and is_in(frame, packages)):
            code = code_of(frame)
            folder = module_of(frame).rpartition(".")[0].replace(".", "/")
            file = os.path.basename(code.co_filename)
            place = f"{folder}/{file}" if folder else file
            name = getattr(code, "co_qualname", code.co_name)  # from Python 3.11 on
            lines.append(f"{place}:{frame.f_lineno} in {name}")
        elif kind == OURS:
            break
        frame = frame.f_back
    return "\n".join(lines)
