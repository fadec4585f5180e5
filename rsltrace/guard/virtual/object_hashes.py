"""Hashes made of object addresses: reported when code asks for one.

Sets and dictionaries ask for them, too, but show none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import FrameType, MethodWrapperType
from typing import Any

from rsltrace.guard.addresses import has_address_hash, note_address_hash
from rsltrace.guard.frames import caller, code_of
from rsltrace.guard.guard import engaged
from rsltrace.guard.redirect import redirect
from rsltrace.trace.model.finding import Source

_of_object = object.__hash__


def _report_hash(obj: object, value: int, frame: FrameType) -> int:
    """Report a hash that code asked for, if it contains addresses."""
    guard = engaged()
    if guard is not None and has_address_hash(obj):
        if code_of(frame).co_name == "__hash__":
            note_address_hash(frame)  # matters where a set of such objects is gone through
        elif guard.is_user(frame):
            kind = type(obj).__qualname__
            guard.report_user_call(Source.ADDRESS, f"hash() of {kind}", value, frame)
    return value


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
