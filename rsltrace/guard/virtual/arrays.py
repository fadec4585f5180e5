"""Memory that numpy leaves as it was: in user code it shows zeros.

``np.empty`` and ``np.empty_like`` are redirected. Types, functions of masked arrays and ``where=``
offer no such hook, so user modules call ``filled`` in place of them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import BuiltinFunctionType, FrameType
from typing import Any

from rsltrace.guard.frames import caller
from rsltrace.guard.guard import Guard, engaged
from rsltrace.guard.redirect import redirect
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource

NEW_ARRAYS = frozenset(
    ("ndarray", "recarray", "chararray", "empty", "masked_all", "masked_all_like")
)
"""Names of numpy's functions and types that make arrays of memory as it is."""
_BUFFER = 3
"""From this number of arguments on, a type of arrays is given its memory."""


def _fills(guard: Guard, frame: FrameType) -> bool:
    return guard.is_user(frame) and (
        guard.mode(NondeterminismSource.RANDOM, frame) is not GuardMode.ALLOW
    )


def _zeroing(real: Callable[..., Any]) -> Any:
    def empty(*arguments: Any, **options: Any) -> Any:
        made = real(*arguments, **options)
        guard = engaged()
        if guard is not None and not made.dtype.hasobject and _fills(guard, caller()):
            _zero(made)
        return made

    return empty


def _zero(made: Any) -> None:
    """Fill an array with the zero of its type, which may be a record or a text."""
    import numpy as np

    np.ndarray.fill(made, np.zeros((), made.dtype)[()])


def filled(function: Any, /, *arguments: Any, **options: Any) -> Any:
    """Call a function; fill with zeros what numpy has left as it was in the arrays it returns."""
    guard, np = engaged(), sys.modules.get("numpy")
    if guard is None or np is None or not _fills(guard, caller()):
        return function(*arguments, **options)
    if (
        isinstance(function, np.ufunc)
        and options.get("out") is None
        and "where" in options
        and len(arguments) <= function.nin
    ):
        # Without "out", numpy warns of memory that is not initialised.
        options["out"] = (None,) * function.nout
        made, left = function(*arguments, **options), np.logical_not(options["where"])
        if isinstance(made, tuple):
            return tuple(_without(np, one, left) for one in made)
        return _without(np, made, left)
    made = function(*arguments, **options)
    owner = str(getattr(function, "__module__", "")).partition(".")[0]
    name = getattr(function, "__name__", "")
    given = isinstance(function, type) and (
        len(arguments) >= _BUFFER or not {"buffer", "buf"}.isdisjoint(options)
    )
    if (
        owner == "numpy"
        and name in NEW_ARRAYS
        and not given
        and isinstance(made, np.ndarray)
        and not made.dtype.hasobject
    ):
        _zero(made)
    return made


def _without(np: Any, made: Any, left: Any) -> Any:
    """Return what a function of numpy has made, with zeros where it has ``left`` memory alone."""
    if isinstance(made, np.ndarray):
        np.copyto(made, np.zeros((), made.dtype), where=left)
        return made
    return np.zeros((), made.dtype)[()] if left and hasattr(made, "dtype") else made


@contextmanager
def zeroed_arrays() -> Iterator[None]:
    """Redirect numpy's functions."""
    with ExitStack() as stack:
        if "numpy" in sys.modules:
            import numpy as np

            redirect(stack, np.empty, _zeroing)
            like = getattr(np.empty_like, "_implementation", None)
            if isinstance(like, BuiltinFunctionType):
                redirect(stack, like, _zeroing)
        yield
