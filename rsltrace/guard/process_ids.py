"""Process ids of the run: each main has one of its own, the same in every run.

They are none that Linux gives (2**22 at most), so whoever is told one can take nobody else for it.
Where the code that got one gives it back, the process of the run is meant.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import PurePath
from types import FrameType
from typing import Any

from rsltrace.guard.frames import code_of
from rsltrace.guard.guard import Guard, engage, engaged
from rsltrace.guard.libraries import TARGETS

# Which questions about files are news: not about what is installed, nor by who reads code.

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
READERS_OF_CODE = {"linecache", "tokenize", "inspect", "traceback", "zipimport", "pkgutil"}
_COMPILED = "/__pycache__/"
_BETWEEN = ("genericpath", "posixpath", "rsltrace.guard.recorded.files")
"""By way of which others ask the file system."""

NOT_NEWS = frozenset(("logging", "threading", *READERS_OF_CODE))
"""Modules that look at such things for records of their own."""


def asking_module(frame: FrameType) -> str | None:
    """Return the name of the module that asks the file system, be it by way of ``os.path``."""
    name = frame.f_globals.get("__name__")
    while name in _BETWEEN and frame.f_back is not None:
        frame = frame.f_back
        name = frame.f_globals.get("__name__")
    return name


def is_resolving(frame: FrameType) -> bool:
    """Return whether a path's links are followed: of a folder on the way nothing else counts."""
    is_of_python = frame.f_globals.get("__name__") == "posixpath"
    return is_of_python and code_of(frame).co_name in ("realpath", "_joinrealpath")


def is_installed(path: object) -> bool:
    """Return whether a file is part of what is installed, whose versions a trace knows, or is made
    of source code and kept beside it."""
    if not isinstance(path, (str, bytes, os.PathLike)):
        return False
    name = os.fsdecode(path)
    if not name.startswith(os.sep):
        with engage(None):  # the working directory that is asked for is no finding
            name = os.path.abspath(name)
    elif "/." in name or "//" in name:
        name = os.path.abspath(name)
    return name.startswith(_INSTALLED) or _COMPILED in f"{name}/"


FIRST = 5_000_000
"""That of the nodes which the job constructs; mains follow in the order of the job."""

_PROC = "/proc/"
_OF_PROCESS = re.compile(r"/proc/(\d+)(?=/|$)")


def virtual_id(guard: Guard) -> int:
    """Return the process id of whoever runs."""
    return FIRST + guard.context.process()


def meant_id(pid: Any) -> Any:
    """Return the real process id if ``pid`` is what whoever runs takes for its own."""
    if isinstance(pid, int) and pid >= FIRST:
        guard = engaged()
        if guard is not None and pid == virtual_id(guard):
            return guard.process
    return pid


def meant_path(path: Any) -> Any:
    """Return a path below ``/proc`` with the real process id in it."""
    if type(path) is str and path[:6] != _PROC:
        return path
    text = os.fspath(path) if isinstance(path, PurePath) else path
    if isinstance(text, str) and text.startswith(_PROC):
        match = _OF_PROCESS.match(text)
        if match is not None:
            return f"{_PROC}{meant_id(int(match[1]))}{text[match.end() :]}"
    return path


__all__ = ["FIRST", "meant_id", "meant_path", "virtual_id"]
