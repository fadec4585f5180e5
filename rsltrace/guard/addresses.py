"""Addresses of objects, where a program can see them: in hashes and in texts."""

from __future__ import annotations

import os
import re
import sys
from types import (
    BuiltinMethodType,
    FrameType,
    GenericAlias,
    MethodType,
    MethodWrapperType,
    UnionType,
)
from weakref import ReferenceType, WeakSet

from rsltrace.guard.frames import code_of
from rsltrace.guard.guard import Guard, engaged
from rsltrace.trace.model.finding import Source

_ADDRESS = re.compile(r"\S* at 0x(?!52[0-9a-f]{10}\b)[0-9a-f]{6,}")
"""An address in a text; not what the guard shows in place of one."""
_ALIKE = object.__hash__
_SEEDED = os.environ.get("PYTHONHASHSEED", "random") == "random"
_OF_PARTS = (tuple.__hash__, frozenset.__hash__)
"""What makes a hash of those of its elements; types that are derived have them, too."""
_POINTING = frozenset((BuiltinMethodType, GenericAlias, MethodType, MethodWrapperType, UnionType))
"""Types that make hashes of addresses in a way of their own."""
_TAKING = frozenset(("__hash__", "__rsltrace_hash__", "id"))
"""What a method that makes a hash of an address has among its names."""


def is_by_address(thing: object) -> bool:
    """Return whether an object's hash differs from process to process."""
    kind = type(thing)
    if kind in (int, float, bool, complex):
        return False
    if kind in (str, bytes):
        return _SEEDED
    if thing is None:
        return sys.version_info < (3, 12)
    method = getattr(kind, "__hash__", None)
    if method in _OF_PARTS:
        return any(map(is_by_address, thing))  # type: ignore[call-overload]
    if isinstance(thing, ReferenceType):
        return is_by_address(thing())
    if method is _ALIKE or kind in _POINTING or kind in _by_address:
        return True
    return not _TAKING.isdisjoint(getattr(getattr(method, "__code__", None), "co_names", ()))


def hashed_by_address(frame: FrameType) -> None:
    """Remember of the ``__hash__`` method that runs in ``frame`` that addresses are in its hash."""
    names = code_of(frame).co_varnames
    if names and code_of(frame).co_argcount:
        _by_address.add(type(frame.f_locals.get(names[0])))


_by_address: WeakSet[type] = WeakSet()
"""Types whose hashes are made of those of objects that are hashed by address."""


def text_with_address(text: str) -> None:
    """Report a text for others to see in which an object's address stands."""
    guard = engaged()
    if guard is not None:
        match = _ADDRESS.search(text)
        if match is not None:
            report_here(guard, Source.ADDRESS, "an address in a log record", match.group())


def report_here(guard: Guard, source: Source, call: str, value: str) -> None:
    """Report something that user code did through our own middleware."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if guard.is_user(frame):
            guard.watched(source, call, value, frame)
            return
        frame = frame.f_back
