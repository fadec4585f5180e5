"""Memory that numpy leaves as it was: it shows zeros.

numpy takes memory through a table of functions (NEP 49). While an array is made whose elements are
not set, the one for memory as it is gives zeros. All the time, that would cost 1.3 times the time
of sums of large arrays. ``np.empty``, ``np.empty_like`` and ``ndarray.__new__`` are redirected,
which takes in aliases and subclasses; calls with ``where=`` are marked in user modules.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from types import BuiltinFunctionType
from typing import Any

from rsltrace.errors import SetupError
from rsltrace.guard.callers import module_of
from rsltrace.guard.frames import caller, replace_special_method
from rsltrace.guard.guard import engaged
from rsltrace.guard.redirect import redirect

_FILL_ALL = frozenset(("numpy._core.numeric", "numpy.core.numeric"))
"""Modules of numpy (``np.ones``, ``np.full``) that set each element of what they get."""
_DEFAULT_HANDLER = 306
"""The place of ``PyDataMem_DefaultHandler`` in numpy's C API."""


class _Handler(ctypes.Structure):
    """The first members of numpy's ``PyDataMem_Handler``. Its own functions ignore ``context``."""

    _fields_ = (
        ("name", ctypes.c_char * 127),
        ("version", ctypes.c_uint8),
        ("context", ctypes.c_void_p),
        ("malloc", ctypes.c_void_p),
    )


_address_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)
_calloc = ctypes.cast(ctypes.CDLL(None).calloc, ctypes.c_void_p).value


@cache
def _handler() -> _Handler:
    core = sys.modules.get("numpy._core._multiarray_umath")
    core = core or sys.modules["numpy.core._multiarray_umath"]  # before numpy 2
    api = (ctypes.c_void_p * (_DEFAULT_HANDLER + 1)).from_address(
        _address_of(core._ARRAY_API, None)
    )
    capsule = ctypes.py_object.from_address(api[_DEFAULT_HANDLER] or 0).value
    handler = _Handler.from_address(_address_of(capsule, b"mem_handler"))
    if (handler.name, handler.version) != (b"default_allocator", 1):
        version = sys.modules["numpy"].__version__
        raise SetupError(
            f"numpy {version} takes memory in a way that the guard does not know; "
            "write 'guard: false' in the job to record without it"
        )
    return handler


def _zeroed(function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Any:
    """Call a function of numpy: ``malloc(context, size)`` is ``calloc(1, size)`` meanwhile."""
    handler = _handler()
    before = handler.context, handler.malloc
    handler.context, handler.malloc = 1, _calloc
    try:
        return function(*arguments, **options)
    finally:
        handler.context, handler.malloc = before


def _zeroing(real: Callable[..., Any]) -> Callable[..., Any]:
    def empty(*arguments: Any, **options: Any) -> Any:
        if engaged() is None or module_of(caller()) in _FILL_ALL:
            return real(*arguments, **options)
        return _zeroed(real, *arguments, **options)

    return empty


def filled(function: Any, /, *arguments: Any, **options: Any) -> Any:
    """Call a function with ``where=``: those of numpy leave elements as they were."""
    numpy: Any = sys.modules.get("numpy")
    of = getattr(function, "__self__", function)  # "outer" and "reduce" are methods
    if numpy is None or engaged() is None or not isinstance(of, numpy.ufunc):
        return function(*arguments, **options)
    if function.__name__ != "reduce" and len(arguments) <= of.nin:
        options.setdefault("out", (None,) * of.nout)  # else numpy warns of such memory
    return _zeroed(function, *arguments, **options)


@contextmanager
def zeroed_arrays() -> Iterator[None]:
    """Redirect numpy's functions."""
    with ExitStack() as stack:
        if "numpy" in sys.modules:
            import numpy as np

            _handler()  # now: looking for it in a callback would be a finding
            redirect(stack, np.empty, _zeroing)
            like = getattr(np.empty_like, "_implementation", None)
            if isinstance(like, BuiltinFunctionType):
                redirect(stack, like, _zeroing)
            replace_special_method(stack, np.ndarray, "__new__", _zeroing)
        yield
