"""Find the calling frame without raising Python's audit events.

Once a process has an audit hook, ``sys._getframe`` and ``frame.f_code`` take 0.2 microseconds each.
The frame of a generator has its caller behind it, and CPython's ``PyFrame_GetCode`` raises no
event.
"""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from types import CodeType, FrameType
from typing import Any

from rsltrace.guard.redirect import method_of

# Replace members of types of extension modules, which Python itself refuses.

_WORDS_BEFORE = {"__repr__": 11, "__iter__": 27, "__init__": 37, "__new__": 39, "vectorcall": 50}
"""The offsets of a CPython type's slots, in words, at least since 3.9; checked."""
_WORD = ctypes.sizeof(ctypes.c_void_p)
_New = ctypes.PYFUNCTYPE(*(ctypes.py_object,) * 4)


class _HasNone:
    pass


class _HasAll:
    def __new__(cls) -> _HasAll:
        return super().__new__(cls)

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
    for name in ("__repr__", "__iter__", "__init__", "__new__")
    if _slot(object, name).value == _slot(_HasNone, name).value != _slot(_HasAll, name).value
}
"""What a slot holds if the type looks the method up by name."""


def replace_member(stack: ExitStack, kind: type, name: str, make: Callable[[Any], Any]) -> None:
    """Replace a member, if the type has it, by ``make(member)`` until ``stack`` ends."""
    real = kind.__dict__.get(name)
    if real is not None:
        set_member(kind, name, make(real))
        stack.callback(set_member, kind, name, real)


def set_member(kind: type, name: str, value: object) -> None:
    """Set a member of a built-in type."""
    (members,) = gc.get_referents(kind.__dict__)
    members[name] = value
    ctypes.pythonapi.PyType_Modified(ctypes.py_object(kind))


def replace_special_method(
    stack: ExitStack, kind: type, name: str, make: Callable[[Any], Any]
) -> None:
    """Replace a method that Python calls without a lookup by name.

    The type and all subclasses that inherit it are changed to look it up.
    """
    slot, by_name = _slot(kind, name).value, _BY_NAME.get(name)
    if by_name is None or slot is None or slot == by_name:
        return
    if name == "__new__":  # the member itself calls what is in the slot
        new = _New(slot)
        made = make(lambda kind, *arguments, **options: new(kind, arguments, options))
        replace_member(stack, kind, name, lambda member: staticmethod(made))
    else:
        replace_member(stack, kind, name, make)
    inheriting = [one for one in _subclasses_of(kind) if _slot(one, name).value == slot]
    _set_slots(stack, inheriting, name, by_name)
    if name == "__init__" and _slot(_HasNone, "vectorcall").value is None:
        _set_slots(stack, [kind], "vectorcall", None)  # which makes an object without it


def _set_slots(stack: ExitStack, kinds: list[type], name: str, value: int | None) -> None:
    """Set a slot, which is the same in all of these types, until ``stack`` ends."""
    stack.callback(_write_slots, kinds, name, _slot(kinds[0], name).value)  # which keeps them, too
    _write_slots(kinds, name, value)


def _write_slots(kinds: list[type], name: str, value: int | None) -> None:
    for kind in kinds:
        _slot(kind, name).value = value


def _subclasses_of(kind: type) -> set[type]:
    found, waiting = {kind}, [kind]
    while waiting:
        new: set[type] = set(type.__subclasses__(waiting.pop())) - found
        found |= new
        waiting += new
    return found


def _callers() -> Iterator[Any]:
    own = sys._getframe(0)
    while True:
        yield own.f_back.f_back  # type: ignore[union-attr]


next_caller = _callers().__next__
"""Return the frame that called the caller, in half the time of ``caller``. Call it as an attribute
of this module; if it raises ``INTERRUPTED``, call ``lost_caller`` instead."""

INTERRUPTED = (ValueError, StopIteration)
"""A signal arrived during another call, or its handler raised."""


def lost_caller() -> FrameType:
    """Return the frame that ``next_caller`` failed to return."""
    global next_caller
    next_caller = _callers().__next__
    return sys._getframe(2)


def caller() -> FrameType:
    """Return the frame that called the caller, as ``sys._getframe(1)`` would there."""
    try:
        return next_caller().f_back  # type: ignore[no-any-return]
    except INTERRUPTED:
        return lost_caller().f_back  # type: ignore[return-value]


code_of: Callable[[FrameType], CodeType] = method_of(
    FrameType, "code_of", ctypes.pythonapi.PyFrame_GetCode
)
"""Return a frame's code."""
