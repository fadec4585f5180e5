"""Addresses of objects where a program can see them: in hashes and in texts."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from datetime import timedelta
from functools import partial
from numbers import Number
from types import (
    BuiltinMethodType,
    FrameType,
    GenericAlias,
    MethodType,
    MethodWrapperType,
    UnionType,
)
from typing import Any
from weakref import ReferenceType, WeakSet

from rsltrace.guard.frames import caller, code_of
from rsltrace.guard.guard import Guard, engaged
from rsltrace.guard.redirect import redirect
from rsltrace.trace.model.finding import NondeterminismSource

# Hashes made of object addresses: reported when code asks for one.
#
# Sets and dictionaries ask for them, too, but show none.

_of_object = object.__hash__


def _report_hash(obj: object, value: int, frame: FrameType) -> int:
    """Report a hash that code asked for, if it contains addresses."""
    guard = engaged()
    if guard is not None and has_address_hash(obj):
        if code_of(frame).co_name == "__hash__":
            note_address_hash(frame)  # matters when a set of such objects is iterated
        elif guard.is_user(frame) or was_passed("hash", frame):
            kind = type(obj).__qualname__
            guard.report_user_call(NondeterminismSource.ADDRESS, f"hash() of {kind}", value, frame)
    return value


def was_passed(name: str, frame: FrameType) -> bool:
    """Return whether the code of a frame calls a built-in function without naming it: a caller has
    passed the function (``heapq.nlargest(2, nodes, key=id)``)."""
    code = code_of(frame)
    return not any(name in names for names in (code.co_names, code.co_varnames, code.co_freevars))


def _hashing(real: Callable[[Any], int]) -> Any:
    def hash_of(obj: Any, /) -> int:
        return _report_hash(obj, real(obj), caller())

    return hash_of


def _objects_hash(obj: Any, /) -> int:
    return _report_hash(obj, _of_object(obj), caller())


def _bound_hash(real: Callable[[], int], /) -> int:
    return _report_hash(real.__self__, real(), caller())  # type: ignore[attr-defined]


def hash_method(owner: Any) -> Any:
    """Return ``owner.__hash__``, or a function that does the same and reports it."""
    real = owner.__hash__
    if real is _of_object:
        return _objects_hash
    return partial(_bound_hash, real) if type(real) is MethodWrapperType else real


@contextmanager
def reported_hashes() -> Iterator[None]:
    """Report the results of the built-in ``hash``."""
    with ExitStack() as stack:
        redirect(stack, hash, _hashing)
        yield


_ADDRESS = re.compile(r"\S* at 0x(?!52[0-9a-f]{10}\b)[0-9a-f]{6,}")
"""An address in a text; the numbers that the guard shows instead begin with 0x52."""
_ALIKE = object.__hash__
_SEEDED = os.environ.get("PYTHONHASHSEED", "random") == "random"
_OF_PARTS = (tuple.__hash__, frozenset.__hash__)
"""Hash methods that combine the hashes of the elements; subclasses inherit them."""
_OF_NUMBERS = (range, timedelta)
"""Types that hash numbers, in C."""
_POINTING = frozenset(
    (BuiltinMethodType, ContextVar, GenericAlias, MethodType, MethodWrapperType, UnionType)
)
"""Types whose own hash methods use addresses."""
_TAKING = frozenset(("__hash__", "__rsltrace_hash__", "id"))
"""Names in the code of a method that makes a hash of an address."""


def has_address_hash(obj: object) -> bool:
    """Return whether an object's hash differs from process to process."""
    kind = type(obj)
    if kind in (int, bool):
        return False
    if isinstance(obj, Number):
        return bool(obj != obj)  # of no number: all would be in one place of a set
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
    code = getattr(method, "__code__", None)
    if code is None:  # in C: dates, patterns and others have the hash of their bytes or texts
        return _SEEDED and kind not in _OF_NUMBERS
    return not _TAKING.isdisjoint(code.co_names)


def note_address_hash(frame: FrameType) -> None:
    """Remember that the ``__hash__`` method which runs in ``frame`` uses addresses."""
    names = code_of(frame).co_varnames
    if names and code_of(frame).co_argcount:
        _by_address.add(type(frame.f_locals.get(names[0])))


_by_address: WeakSet[type] = WeakSet()
"""Types whose hashes include those of objects that are hashed by address."""


def report_address_in_text(text: str) -> None:
    """Report a text for others to read that contains an object's address."""
    guard = engaged()
    if guard is not None:
        match = _ADDRESS.search(text)
        if match is not None and not match[0].endswith(guard.shown.reported or " "):
            report_from_middleware(
                guard, NondeterminismSource.ADDRESS, "an address in a log record", match.group()
            )


def report_from_middleware(
    guard: Guard, source: NondeterminismSource, call: str, value: str
) -> None:
    """Report something that user code did through rsltrace's middleware."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if guard.is_user(frame):
            guard.report_user_call(source, call, value, frame)
            return
        frame = frame.f_back
