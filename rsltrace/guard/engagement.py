"""Which guard is engaged in the calling thread."""

from __future__ import annotations

import threading
from typing import Any

from rsltrace.guard.redirect import copy_of

thread_id = copy_of(threading.get_ident)
_engaged: list[Any] = []


def engaged() -> Any:
    """Return the guard engaged in the calling thread (never in a child process), or None."""
    if _engaged:
        guard = _engaged[-1]
        if guard.thread == thread_id():
            return guard
    return None


class engage:  # noqa: N801  (used like a function)
    """Engage ``guard`` in this thread for the block (None: no guard)."""

    __slots__ = ("_before", "_guard")

    def __init__(self, guard: Any) -> None:
        self._guard = guard
        self._before: list[Any] = []

    def __enter__(self) -> None:
        if self._guard is None:
            self._before = _engaged[:]
            _engaged.clear()
        else:
            _engaged.append(self._guard)

    def __exit__(self, *error: object) -> None:
        if self._guard is None:
            _engaged[:] = self._before
        else:
            _engaged.remove(self._guard)
