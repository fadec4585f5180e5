"""Where the code of a callback is: file and line, in words that hold on any machine."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import PurePath
from types import CodeType, CoroutineType, FunctionType, MethodType

_WRAPPED_MAX = 50


def source_of(callback: object) -> str:
    """Return ``package/module.py:24`` of the function that a callback runs in the end, or "".

    The line is that of ``def``, or of its first decorator. The file is named as it is imported, so
    that traces do not differ by the folder in which they were made.
    """
    found = function_of(callback)
    if found is None:
        return ""
    code, names = found
    return f"{file_of(code, names)}:{code.co_firstlineno}" if code.co_filename[:1] != "<" else ""


def function_of(callback: object) -> tuple[CodeType, Mapping[str, object]] | None:
    """Return the code that a callback runs in the end, with its module's names; None if unknown.

    Goes through methods, partials, decorators and callable objects (which may answer anything).
    """
    for _ in range(_WRAPPED_MAX):
        if isinstance(callback, partial):
            callback = callback.func
        elif isinstance(callback, MethodType):
            callback = callback.__func__
        elif isinstance(callback, FunctionType):
            wrapped = callback.__dict__.get("__wrapped__")
            if wrapped is None:
                return callback.__code__, callback.__globals__
            callback = wrapped
        elif isinstance(callback, CoroutineType):
            frame = callback.cr_frame
            return (callback.cr_code, frame.f_globals) if frame is not None else None
        elif isinstance(callback, type):
            callback = callback.__init__  # type: ignore[misc]
        else:
            callbacks = (vars(one).get("__call__") for one in type(callback).__mro__)
            callback = next((one for one in callbacks if one is not None), None)
            if not isinstance(callback, FunctionType):
                return None
    return None


def file_of(code: CodeType, names: Mapping[str, object]) -> str:
    """Return a code's file as it is imported, ``package/module.py``: the same on any machine."""
    path = PurePath(code.co_filename)
    module = names.get("__name__")
    if isinstance(module, str):
        package = PurePath(*module.split("."))
        for tail in (package.with_suffix(".py"), package / "__init__.py"):
            if path.parts[-len(tail.parts) :] == tail.parts:
                return tail.as_posix()
    return path.name
