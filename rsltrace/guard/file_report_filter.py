"""Which file accesses are reported: not of installed files, nor by code that reads sources."""

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
