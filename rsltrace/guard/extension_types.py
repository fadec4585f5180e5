"""Exchanging members of types of extension modules, which Python itself refuses."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any


def exchange(stack: ExitStack, kind: type, name: str, make: Callable[[Any], Any]) -> None:
    """Exchange a member, if the type has it, for what ``make`` makes of it until ``stack`` ends."""
    real = kind.__dict__.get(name)
    if real is not None:
        put_member(kind, name, make(real))
        stack.callback(put_member, kind, name, real)


def put_member(kind: type, name: str, value: object) -> None:
    """Set a member of a built-in type."""
    (members,) = gc.get_referents(kind.__dict__)
    members[name] = value
    ctypes.pythonapi.PyType_Modified(ctypes.py_object(kind))
