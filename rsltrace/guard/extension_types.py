"""Exchanging members of types of extension modules, which Python itself refuses."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

_WORDS_BEFORE = {"__repr__": 11, "__iter__": 27, "__init__": 37, "vectorcall": 50}
"""Where a type of CPython keeps the functions that it calls itself, at least since 3.9; checked."""
_WORD = ctypes.sizeof(ctypes.c_void_p)


class _HasNone:
    pass


class _HasAll:
    def __init__(self) -> None:
        pass

    def __repr__(self) -> str:
        return ""

    def __iter__(self) -> Iterator[None]:
        yield None


def _slot(kind: type, name: str) -> ctypes.c_void_p:
    return ctypes.c_void_p.from_address(id(kind) + _WORDS_BEFORE[name] * _WORD)


_BY_NAME = {
    name: _slot(_HasAll, name).value
    for name in ("__repr__", "__iter__", "__init__")
    if _slot(object, name).value == _slot(_HasNone, name).value != _slot(_HasAll, name).value
}
"""What a type has there that looks for the method by its name."""


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


def exchange_special(stack: ExitStack, kind: type, name: str, make: Callable[[Any], Any]) -> None:
    """Exchange in the same way a method that Python calls without looking for it by name: the type,
    and all that have it from there, are told to look."""
    slot, by_name = _slot(kind, name).value, _BY_NAME.get(name)
    if by_name is None or slot == by_name:
        return
    exchange(stack, kind, name, make)
    for one in _all_below(kind):
        if _slot(one, name).value == slot:
            _set_slot(stack, one, name, by_name)
    if name == "__init__" and _slot(_HasNone, "vectorcall").value is None:
        _set_slot(stack, kind, "vectorcall", None)  # which makes an object without it


def _set_slot(stack: ExitStack, kind: type, name: str, value: int | None) -> None:
    slot = _slot(kind, name)
    stack.callback(setattr, slot, "value", slot.value)
    slot.value = value


def _all_below(kind: type) -> set[type]:
    """Return a type with all that are derived from it."""
    found, waiting = {kind}, [kind]
    while waiting:
        new: set[type] = set(type.__subclasses__(waiting.pop())) - found
        found |= new
        waiting += new
    return found
