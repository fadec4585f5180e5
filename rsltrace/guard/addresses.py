"""Addresses of objects where a program can see them: in hashes and in texts."""

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
"""An address in a text; the numbers that the guard shows instead begin with 0x52."""
_ALIKE = object.__hash__
_SEEDED = os.environ.get("PYTHONHASHSEED", "random") == "random"
_OF_PARTS = (tuple.__hash__, frozenset.__hash__)
"""Hash methods that combine the hashes of the elements; subclasses inherit them."""
_POINTING = frozenset((BuiltinMethodType, GenericAlias, MethodType, MethodWrapperType, UnionType))
"""Types whose own hash methods use addresses."""
_TAKING = frozenset(("__hash__", "__rsltrace_hash__", "id"))
"""Names in the code of a method that makes a hash of an address."""


def has_address_hash(obj: object) -> bool:
    """Return whether an object's hash differs from process to process."""
    kind = type(obj)
    if kind in (int, float, bool, complex):
        return False
    if kind in (str, bytes):
        return _SEEDED
    if obj is None:
        return sys.version_info < (3, 12)
    method = getattr(kind, "__hash__", None)
    if method in _OF_PARTS:
        return any(map(has_address_hash, obj))  # type: ignore[call-overload]
    if isinstance(obj, ReferenceType):
        return has_address_hash(obj())
    if method is _ALIKE or kind in _POINTING or kind in _by_address:
        return True
    return not _TAKING.isdisjoint(getattr(getattr(method, "__code__", None), "co_names", ()))


def note_address_hash(frame: FrameType) -> None:
    """Remember that the ``__hash__`` method which runs in ``frame`` uses addresses."""
    names = code_of(frame).co_varnames
    if names and code_of(frame).co_argcount:
        _by_address.add(type(frame.f_locals.get(names[0])))


_by_address: WeakSet[type] = WeakSet()
"""Types whose hashes include those of objects that are hashed by address."""


def text_with_address(text: str) -> None:
    """Report a text for others to read that contains an object's address."""
    guard = engaged()
    if guard is not None:
        match = _ADDRESS.search(text)
        if match is not None:
            report_from_middleware(
                guard, Source.ADDRESS, "an address in a log record", match.group()
            )


def report_from_middleware(guard: Guard, source: Source, call: str, value: str) -> None:
    """Report something that user code did through rsltrace's middleware."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if guard.is_user(frame):
            guard.report_user_call(source, call, value, frame)
            return
        frame = frame.f_back
