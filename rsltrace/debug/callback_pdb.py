"""``pdb`` in the first line of a callback, over a socket: a simulation has no terminal.

The lines are JSON: ``{"write": text}`` and ``{"read": true}`` from here, ``{"line": text}`` (null
at the end) as the client's answer to the second.
"""

from __future__ import annotations

import json
import pdb
import socket
from bdb import BdbQuit
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any

from rsltrace.debug.current_event import is_users
from rsltrace.errors import DebugError
from rsltrace.guard.guard import engage

_SKIPPED = ("rsltrace", "rsltrace.*", "rclpy", "rclpy.*", "greenlet", "greenlet.*")
"""What is neither stopped in nor stepped into: it stands between a run and its callbacks."""


class PdbConnection:
    """A remote terminal, as far as ``pdb`` needs one."""

    def __init__(self, address: str) -> None:
        """Connect to the socket of a path.

        :raises DebugError: no client listens there.
        """
        self._end = socket.socket(socket.AF_UNIX)
        try:
            self._end.connect(address)
        except OSError as error:
            self._end.close()
            raise DebugError(f"no client listens at {address}: {error}") from error
        self._lines = self._end.makefile("rw", encoding="utf-8")

    def write(self, text: str) -> int:
        self._send({"write": text})
        return len(text)

    def flush(self) -> None:
        """Do nothing: every text is sent at once."""

    def readline(self) -> str:
        """Return a line from the client; empty at the end."""
        self._send({"read": True})
        with suppress(OSError, ValueError):
            line = json.loads(self._lines.readline() or '{"line": null}').get("line")
            return "" if line is None else f"{line}\n"
        return ""

    def close(self) -> None:
        with suppress(OSError):
            self._lines.close()
        self._end.close()

    def _send(self, message: dict[str, Any]) -> None:
        with suppress(OSError):
            self._lines.write(json.dumps(message) + "\n")
            self._lines.flush()


class CallbackPdb(pdb.Pdb):
    """Stops in the first line of user code below the function it calls."""

    def __init__(self, conversation: PdbConnection) -> None:
        super().__init__(
            stdin=conversation,  # type: ignore[arg-type]
            stdout=conversation,  # type: ignore[arg-type]
            skip=_SKIPPED,
            nosigint=True,
        )
        self.use_rawinput = False
        self._has_begun = False

    def user_call(self, frame: FrameType, argument_list: Any) -> None:
        """Skip the call event: the first line follows."""
        if self._has_begun:
            super().user_call(frame, argument_list)

    def user_line(self, frame: FrameType) -> None:
        if not (self._has_begun or is_users(frame.f_code)):
            self.set_step()
            return
        self._has_begun = True
        super().user_line(frame)

    def user_return(self, frame: FrameType, return_value: Any) -> None:
        if self._has_begun:
            super().user_return(frame, return_value)

    def user_exception(self, frame: FrameType, exc_info: Any) -> None:
        if self._has_begun:
            super().user_exception(frame, exc_info)

    def interaction(self, *where: Any) -> None:
        """Talk to the user; the guard does not apply to what they evaluate."""
        with engage(None):
            super().interaction(*where)


def call_under_pdb(callback: Callable[..., Any], args: tuple[Any, ...], address: str) -> str:
    """Call a callback under ``pdb``; return the exception it raised as text, or "".

    :raises DebugError: no client listens at ``address``.
    """
    with engage(None):
        conversation = PdbConnection(address)
        debugger = CallbackPdb(conversation)
    try:
        debugger.runcall(callback, *args)
    except BdbQuit:
        return ""
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    finally:
        with engage(None):
            conversation.close()
    return ""
