"""Hashes of objects that are made of their addresses: reported to who looks at one.

That a set or a dictionary asks for them is nobody's business: neither shows them.
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


def _report_hash(thing: object, value: int, frame: FrameType) -> int:
    """Report a hash that code asked for, if addresses are in it."""
    guard = engaged()
    if guard is not None and has_address_hash(thing):
        if code_of(frame).co_name == "__hash__":
            note_address_hash(frame)  # matters where a set of such objects is gone through
        elif guard.is_user(frame):
            kind = type(thing).__qualname__
            guard.report_user_call(Source.ADDRESS, f"hash() of {kind}", value, frame)
    return value


def _hashing(real: Callable[[Any], int]) -> Any:
    def hash_of(thing: Any, /) -> int:
        return _report_hash(thing, real(thing), caller())

    return hash_of


def _objects_hash(thing: Any, /) -> int:
    return _report_hash(thing, _of_object(thing), caller())


def _bound_hash(real: Callable[[], int], /) -> int:
    return _report_hash(real.__self__, real(), caller())  # type: ignore[attr-defined]


def hash_method(owner: Any) -> Any:
    """Return what ``owner.__hash__`` is, or what does the same and reports it."""
    real = owner.__hash__
    if real is _of_object:
        return _objects_hash
    return partial(_bound_hash, real) if type(real) is MethodWrapperType else real


@contextmanager
def reported_hashes() -> Iterator[None]:
    """Report what the built-in ``hash`` gives."""
    with ExitStack() as stack:
        redirect(stack, hash, _hashing)
        yield
