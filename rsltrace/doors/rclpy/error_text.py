"""What a callback that raised says: its text, its traceback, the exit status it asks for.

User exceptions can be anything: ``__str__`` may raise, and texts may hold what no file can.
"""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from rsltrace.doors.rclpy.hints import hint_for
from rsltrace.errors import NodeError
from rsltrace.model.stamp import format_seconds

_PACKAGE = str(Path(__file__).resolve().parents[2])


@dataclass(frozen=True, slots=True)
class Raised:
    """An exception that came out of an event.

    ``label`` names the event, ``node`` is the node's full name or empty, ``stamp_ns`` the simulated
    time, ``traceback`` the user's frames and ``said`` the exception's own words as text.
    """

    error: BaseException
    label: str
    node: str
    stamp_ns: int
    traceback: str
    said: str

    @property
    def kind(self) -> str:
        """The name of the exception's class."""
        return type(self.error).__qualname__

    @property
    def where(self) -> str:
        """The event and its time, for an error message."""
        return f"{self.label}, at simulated time {format_seconds(self.stamp_ns)} s"

    def as_error(self) -> NodeError:
        """Return the error with which the run ends because of it."""
        return NodeError(
            f"{self.where} raised {self.kind}: {self.said}{hint_for(self.error)}",
            node=self.node,
            entity=self.label,
            stamp_ns=self.stamp_ns,
            traceback_text=self.traceback,
        )


def exit_status(error: SystemExit) -> int:
    """Return the status with which Python would end."""
    if error.code is None:
        return 0
    return error.code if isinstance(error.code, int) else 1


def end_child(error: BaseException) -> NoReturn:
    """End a process that a callback forked and left by an exception: the run is its parent's."""
    if not isinstance(error, SystemExit):
        traceback.print_exception(error)
    elif error.code is not None and not isinstance(error.code, int):
        print(text_of(error), file=sys.stderr)
    with contextlib.suppress(Exception):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit((exit_status(error) if isinstance(error, SystemExit) else 1) & 0xFF)


def text_of(error: BaseException) -> str:
    """Return what an exception says, as text that can be written to any file."""
    try:
        return _writable(str(error))
    except Exception:
        return "(its text could not be made)"


def _writable(text: str) -> str:
    return text.encode("utf-8", "backslashreplace").decode()


def user_traceback(error: BaseException) -> str:
    """Return the traceback without the frames of rsltrace that lead to the user's code."""
    tb = error.__traceback__
    while tb is not None and tb.tb_frame.f_code.co_filename.startswith(_PACKAGE):
        tb = tb.tb_next
    if tb is None:
        tb = error.__traceback__
    with contextlib.suppress(Exception):
        return _writable("".join(traceback.format_exception(type(error), error, tb)))
    return f"{type(error).__qualname__} (its text could not be made)"
