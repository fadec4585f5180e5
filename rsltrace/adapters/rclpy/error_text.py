"""The exit status that an exception asks for, and how a forked process ends by one."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import NoReturn

from rsltrace.simulation.middleware.events.failure import text_of, user_traceback
from rsltrace.terminal import tell


def exit_status(error: SystemExit) -> int:
    """Return the status with which Python would end."""
    if error.code is None:
        return 0
    return int(error.code) if isinstance(error.code, int) else 1


def end_child(error: BaseException) -> NoReturn:
    """End a process that a callback forked and left by an exception: the run is its parent's."""
    if not isinstance(error, SystemExit):
        tell(user_traceback(error), end="")
    elif error.code is not None and not isinstance(error.code, int):
        tell(text_of(error))
    with contextlib.suppress(Exception):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit((exit_status(error) if isinstance(error, SystemExit) else 1) & 0xFF)
