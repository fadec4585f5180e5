"""Reads of ``os.environ``: found, or recorded and given again.

``os.environ`` is an object of a Python class. For the time of a run it gets a class derived from
that one. Its own class is left alone: methods that are set on a class again and again (twice per
run) cost it its place in the interpreter's caches, and Python 3.13 then goes on to call the
``__getitem__`` that it has cached, whatever the class says.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from rsltrace.guard.callers import is_of_python, module_of
from rsltrace.guard.frames import caller, code_of
from rsltrace.guard.guard import Guard, engaged
from rsltrace.guard.libraries import is_library
from rsltrace.trace.model.finding import READ_BY, Mode, Source

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
