"""Functions of the C library that nodes load through cffi, reported like those through ctypes."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import Any

from rsltrace.guard.frames import caller
from rsltrace.guard.guard import engaged
from rsltrace.guard.redirect import replace_attribute
from rsltrace.guard.rules import C_FUNCTIONS

CFFI_LOADER = "cffi.api"
"""The module of cffi that opens libraries (``ffi.dlopen``)."""


class _Library:
    """A library of cffi that reports the functions taken from it."""

    def __init__(self, real: Any) -> None:
        self._real = real

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    def load_function(self, kind: Any, name: str) -> Any:
        """Return a function; cffi keeps it and calls this once."""
        guard = engaged()
        source = C_FUNCTIONS.get(name)
        if guard is not None and source is not None:
            guard.report_user_call(source, f"C library: {name}()", "", caller())
        return self._real.load_function(kind, name)


def report_cffi_functions(stack: ExitStack) -> None:
    """Report functions of libraries that nodes open from now on, until ``stack`` ends."""
    module = sys.modules[CFFI_LOADER]
    real = getattr(module, "_load_backend_lib", None)
    if real is not None:
        replace_attribute(stack, module, "_load_backend_lib", lambda *given: _Library(real(*given)))
