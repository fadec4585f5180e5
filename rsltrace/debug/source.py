"""The user's code of an event: what it calls, and the line at which that waits or goes on."""

from __future__ import annotations

import inspect
import os
import sys
import threading
from functools import cache
from types import CodeType, FrameType
from typing import TYPE_CHECKING, Any

from rsltrace.trace.format import EVENT_REST
from rsltrace.trace.model.event import EventFlag, EventKind

if TYPE_CHECKING:
    from rsltrace.debug.ledger import Ledger
    from rsltrace.debug.view import View

_LINES_MAX = 400
_FLAGS = 10
_SUSPENDED = int(EventFlag.SUSPENDED)
_PYTHON = os.path.dirname(threading.__file__) + os.sep
_PACKAGES = f"{os.sep}site-packages{os.sep}"


def code_of(callback: Any) -> CodeType | None:
    """Return the code of a callback, None if it is not written in Python."""
    callback = getattr(callback, "func", callback)
    callback = inspect.unwrap(getattr(callback, "__func__", callback))
    code = getattr(callback, "__code__", None)
    return code if isinstance(code, CodeType) else None


def source(view: View, ledger: Ledger) -> dict[str, Any] | None:
    """Return file, first line, name and lines of what the present event calls of the user's.

    ``at`` is the line at which that waits, or is about to go on; None where it does neither.
    """
    frame = _frame(view) if _is_inside(view, ledger) else None
    code = code_of(_function(view)) if frame is None else frame.f_code
    if code is None or not is_users(code):
        return None
    try:
        lines, first = inspect.getsourcelines(code)
    except (OSError, TypeError):
        lines, first = [], code.co_firstlineno
    return {
        "file": code.co_filename,
        "line": max(first, 1),  # 0: a whole file
        "name": getattr(code, "co_qualname", code.co_name),
        "lines": [line.rstrip("\n") for line in lines[:_LINES_MAX]],
        "at": None if frame is None else frame.f_lineno,
    }


def _function(view: View) -> Any:
    """Return what is called: of an event that has made a node, its constructor."""
    if view.kind == EventKind.CONSTRUCT:
        made = view.nodes().get(view.node or view.entity_name)
        return None if made is None else type(made).__init__
    return view.call.callback


def _is_inside(view: View, ledger: Ledger) -> bool:
    """Say whether the run stands in the middle of the callback: it waits, or goes on."""
    if view.is_next:
        return view.kind == EventKind.RESUME
    return bool(ledger.rest) and bool(EVENT_REST.unpack(ledger.rest)[_FLAGS] & _SUSPENDED)


def _frame(view: View) -> FrameType | None:
    """Return the innermost frame of the user's, on this stack or of a coroutine."""
    if view.call.task is not None:
        found = None
        coroutine = view.call.task.task._handler
        while (frame := getattr(coroutine, "cr_frame", None)) is not None:
            found = frame if is_users(frame.f_code) else found
            coroutine = coroutine.cr_await
        return found
    here: FrameType | None = sys._getframe()
    while here is not None and not is_users(here.f_code):
        here = here.f_back
    return here


def is_users(code: CodeType) -> bool:
    """Say whether code is the user's: neither Python's own, nor rclpy's, nor ours."""
    file = code.co_filename
    if file.startswith(("<frozen", *_between())):
        return False
    return not file.startswith(_PYTHON) or _PACKAGES in file


@cache
def _between() -> tuple[str, ...]:
    """Return the folders of what stands between a run and its callbacks."""
    import rclpy

    import rsltrace

    return tuple(os.path.dirname(str(one.__file__)) + os.sep for one in (rsltrace, rclpy))
