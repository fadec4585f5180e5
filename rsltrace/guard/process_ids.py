"""Process ids of the run: each main has its own, the same in every run.

They are larger than any id of Linux (2**22), so they name no other process. Where user code passes
one to the system, the real process is meant.
"""

from __future__ import annotations

import os
import re
from pathlib import PurePath
from typing import Any

from rsltrace.guard.guard import Guard, engaged

FIRST = 5_000_000
"""The id of the nodes that the job constructs; the ids of mains follow in the order of the job."""

_PROC = "/proc/"
_OF_PROCESS = re.compile(r"/proc/(\d+)(?=/|$)")


def virtual_id(guard: Guard) -> int:
    """Return the process id that the running code sees."""
    return FIRST + guard.context.process()


def real_id(pid: Any) -> Any:
    """Return the real process id if ``pid`` is the one that the running code sees as its own."""
    if isinstance(pid, int) and pid >= FIRST:
        guard = engaged()
        if guard is not None and pid == virtual_id(guard):
            return guard.process
    return pid


def real_path(path: Any) -> Any:
    """Return a path below ``/proc`` with the real process id in it."""
    if type(path) is str and path[:6] != _PROC:
        return path
    text = os.fspath(path) if isinstance(path, PurePath) else path
    if isinstance(text, str) and text.startswith(_PROC):
        match = _OF_PROCESS.match(text)
        if match is not None:
            return f"{_PROC}{real_id(int(match[1]))}{text[match.end() :]}"
    return path
