"""Texts of objects that have none of their own: a number of the run's in place of the address.

``<Robot object at 0x7f…>`` goes into log records, keys and sorted lists. ``object.__repr__`` and
those of functions, generators and coroutines are exchanged for the time of a run; every type that
takes its text from them is told to look for it by name.
"""

from __future__ import annotations

import ctypes
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import AsyncGeneratorType, CoroutineType, FunctionType, GeneratorType
from typing import Any

from rsltrace.guard.extension_types import exchange_special
from rsltrace.guard.frames import caller
from rsltrace.guard.guard import Guard, engage, engaged
from rsltrace.trace.model.finding import Mode, Source

_as_method = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.py_object)(
    ("PyInstanceMethod_New", ctypes.pythonapi)
)
_SHOWN_ALIKE = (FunctionType, GeneratorType, CoroutineType, AsyncGeneratorType)


def _numbered(real: Callable[[Any], str]) -> Callable[[Any], str]:
    def __repr__(self: Any, /) -> str:  # noqa: N807
        text = real(self)
        guard = engaged()
        if guard is None or guard.mode(Source.ADDRESS, caller()) is Mode.ALLOW:
            return text
        with engage(None):
            address = f"0x{id(self):x}"
            return text.replace(address, _shown(guard, self) or address)

    # Neither a function nor new: numba's jitclass looks for what a class adds to ``object``.
    vars(__repr__)["__objclass__"] = getattr(real, "__objclass__", None)
    method: Callable[[Any], str] = _as_method(__repr__)
    return method


def _shown(guard: Guard, thing: Any) -> str | None:
    """Return what stands for the address of an object: the node's number for it, in hexadecimal.

    Addresses do not begin like that. None for an object that cannot be recognised later.
    """
    node = guard.context.node()
    number = guard.shown.number(node, thing)
    if number is None:
        return None
    return f"0x52{zlib.crc32(node.encode('utf-8', 'replace')) & 0xFFFF:04x}{number * 16:06x}"


@contextmanager
def numbered_texts() -> Iterator[None]:
    """Exchange what makes texts with addresses; which guard numbers is asked at each call."""
    with ExitStack() as stack:
        for kind in (object, *_SHOWN_ALIKE):
            exchange_special(stack, kind, "__repr__", _numbered)
        yield


__all__ = ["numbered_texts"]
