"""Which questions about files are news: not about what is installed, nor by who reads code."""

from __future__ import annotations

import os
import sys
from types import FrameType

from rsltrace.guard.frames import code_of
from rsltrace.guard.guard import engage
from rsltrace.guard.libraries import TARGETS

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
