"""Who makes a call: the user's code, a library, Python's own modules, or rsltrace."""

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
"""Who owns a source file: the user, rclpy or rsltrace (``OURS``), Python (``STANDARD``), the user
as an installed package, a library, or the import system."""

_ADAPTER = os.path.join(_HERE, "adapters", "rclpy")
_CALLS_BACK = os.path.join(_HERE, "simulation", "middleware", "events", "dispatcher.py")
"""The only file of rsltrace that calls callbacks; rclpy's own files do, too."""
_THREADS = os.path.join(_ADAPTER, "concurrency", "threads.py")
_REPLACEMENTS = (
    os.path.join(_ADAPTER, "concurrency", "asyncio_loops.py"),
    os.path.join(_ADAPTER, "terminals.py"),
)
"""Replacements of parts of asyncio, os and select: their callers count."""


class _FileKinds(dict[str, int]):
    """The owners of source files, by file name."""

    def __missing__(self, file: str) -> int:
        """Determine the owner and remember it."""
        kind = self[file] = _kind_of(file)
        return kind


def _kind_of(file: str) -> int:
    if file.startswith("<frozen importlib"):
        return _IMPORT
    if file.startswith(_GUARD) or file in _REPLACEMENTS:
        return STANDARD  # a redirected function: its caller counts
    if file.startswith(_HERE) or any(
        f"{installed}{name}{os.sep}" in file for installed in INSTALLED for name in _MIDDLEWARE
    ):
        return OURS  # rclpy, too: its calls are not the user's
    if is_library(file):
        return _LIBRARY
    if is_installed(file):
        return _PACKAGE
    return STANDARD if file.startswith(("<frozen", *_PYTHON)) else USER


FILE_OWNERS = _FileKinds()
"""The owner of each source file; hot paths look here directly."""


def is_installed(file: str) -> bool:
    """Return whether a file is of an installed package, a library's or the user's."""
    return any(part in file for part in INSTALLED)


def _is_dispatcher(file: str) -> bool:
    if file.startswith(_HERE):
        return file == _CALLS_BACK
    return f"{os.sep}rclpy{os.sep}" in file


def is_rsltrace_module(module: str) -> bool:
    """Return whether a module is rsltrace's; it may lie in a folder of user code."""
    return module.partition(".")[0] in ("rsltrace", "rsltrace_viewer")


def is_user_file(file: str) -> bool:
    """Return whether a source file is the user's."""
    return FILE_OWNERS[file] in (USER, _PACKAGE)


def is_user_or_library_file(file: str) -> bool:
    """Return whether a source file is the user's or a library's, not Python's, rclpy's or
    rsltrace's."""
    return FILE_OWNERS[file] in (USER, _PACKAGE, _LIBRARY)


def is_python_frame(frame: FrameType) -> bool:
    """Return whether a frame is of Python's own modules, or of the guard."""
    return FILE_OWNERS[code_of(frame).co_filename] == STANDARD


def is_never_user_code(frame: FrameType | None) -> bool:
    """Return whether ``user_frame`` is certainly None, as far as a quick look tells: rclpy,
    rsltrace or an import calls, directly or through Python's own modules."""
    while frame is not None:
        file = code_of(frame).co_filename
        kind = FILE_OWNERS[file]
        if kind != STANDARD:
            return kind == _IMPORT or (kind == OURS and file != _THREADS)
        frame = frame.f_back
    return False


def user_frame(frame: FrameType | None, packages: frozenset[str]) -> FrameType | None:
    """Return the innermost frame of user code that led to ``frame``, or None.

    User code is any file that is neither Python's nor a library's, any module in ``packages``
    (where nodes are), and a callback in a library. What an installed package does while it is
    imported does not count, nor what rsltrace and rclpy do for themselves. A thread counts as the
    work of the code that started it, even if it runs only Python's own code.
    """
    installed = library = standard = None
    while frame is not None:
        file = code_of(frame).co_filename
        kind = FILE_OWNERS[file]
        if kind == USER:
            return installed or frame
        if kind == OURS:
            if file == _THREADS:
                return installed or library or standard
            return installed or (library and (library if _is_dispatcher(file) else None))
        if packages and (_packages_by_file.get(file) or _package_of(frame, file)) in packages:
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
    """Return whether an installed package is being imported, rather than user code run."""
    while frame is not None:
        kind = FILE_OWNERS[code_of(frame).co_filename]
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
    top = _packages_by_file.get(file)
    return (_package_of(frame, file) if top is None else top) in packages


_packages_by_file: dict[str, str] = {}


def _package_of(frame: FrameType, file: str) -> str:
    top = module_of(frame).partition(".")[0]
    if top != "__main__":  # a program in this run, perhaps a module in the next
        _packages_by_file[file] = top
    return top


def module_of(frame: FrameType) -> str:
    """Return the name of a frame's module."""
    return str(frame.f_globals.get("__name__", ""))


def user_stack(frame: FrameType | None, packages: frozenset[str]) -> str:
    """Return the lines of user code from ``frame`` outwards, without paths of this machine."""
    lines: list[str] = []
    while frame is not None and len(lines) < _LINES_MAX:
        kind = FILE_OWNERS[code_of(frame).co_filename]
        if kind in (USER, _PACKAGE) or (packages and is_in(frame, packages)):
            code = code_of(frame)
            file = os.path.basename(code.co_filename)
            module = module_of(frame)
            package = module if file == "__init__.py" else module.rpartition(".")[0]
            folder = package.replace(".", "/")
            place = f"{folder}/{file}" if folder else file
            name = getattr(code, "co_qualname", code.co_name)  # from Python 3.11 on
            lines.append(f"{place}:{frame.f_lineno} in {name}")
        elif kind == OURS:
            break
        frame = frame.f_back
    return "\n".join(lines)
