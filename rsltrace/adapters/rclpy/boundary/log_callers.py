"""Who logs: rclpy's logger looks for its caller at every call, here it does once per source file.

rclpy walks up the stack with ``inspect.getframeinfo``, which reads source files, and
``os.path.realpath``: half a millisecond, of which nothing but the line can be new. What it finds
(and so what ``once``, ``skip_first`` and throttles go by) is the same here.
"""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from rsltrace.guard.guard import engage

_FIELDS = ("function_name", "file_path", "line_number", "last_index")


@contextmanager
def quick_log_callers() -> Iterator[None]:
    """Let rclpy's logger find its callers quickly within the ``with`` block."""
    from rclpy.impl import rcutils_logger

    logger: Any = rcutils_logger
    real = logger.CallerId
    if getattr(real, "_fields", None) == _FIELDS:  # else it is of a release that is not known here
        logger.CallerId = _quick(logger, real)
    try:
        yield
    finally:
        logger.CallerId = real


def _quick(logger: Any, real: Any) -> Any:
    """Return a ``CallerId`` that does what ``real`` does and remembers what it knows of files."""
    internal: list[str] = []
    """What was in rclpy's list of its own files when ``places`` was made; others may add theirs."""
    places: dict[str, str | None] = {}
    """Absolute paths by the names in code objects; None for files of rclpy's logging."""
    make = tuple.__new__

    def place_of(frame: FrameType) -> str | None:
        with engage(None):  # the logger's look at source files is no finding
            path = os.path.abspath(inspect.getframeinfo(frame).filename)
            is_internal = logger._find_caller(frame) is not frame
        return None if is_internal else path

    class CallerId(real):  # type: ignore[misc]
        __slots__ = ()

        def __new__(cls, frame: FrameType | None = None) -> Any:
            if frame:
                return super().__new__(cls, frame)
            if logger._internal_callers != internal:
                places.clear()
                internal[:] = logger._internal_callers
            above: FrameType | None = sys._getframe(1)
            while above is not None:
                code = above.f_code
                file = code.co_filename
                try:
                    place = places[file]
                except KeyError:
                    place = place_of(above)
                    if os.path.isabs(file):  # others depend on the working directory
                        places[file] = place
                if place is not None:
                    return make(cls, (code.co_name, place, above.f_lineno, above.f_lasti))
                above = above.f_back
            return super().__new__(cls)  # which says what is wrong

    return CallerId
