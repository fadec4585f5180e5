"""Debuggers of Python in copies of a simulation: what calls the callbacks there."""

from __future__ import annotations

import select
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

from rsltrace.debug.source import code_of
from rsltrace.debug.view import View
from rsltrace.line_protocol import Lines, Message

Calls = Callable[..., None]
"""Takes a callback and its arguments."""


class Copy(Protocol):
    """A copy of a simulation, made for a debugger."""

    lines: Lines
    view: View

    def outside(self) -> AbstractContextManager[None]:
        """Do what is no part of the run."""

    def end_apart(self, **answer: Any) -> None:
        """End the copy with an answer."""


def debugger(copy: Copy, request: Message) -> Calls:
    """Return what calls the next callbacks under the debugger that a request names.

    :raises DebugError: there is none such here.
    """
    if request["do"] == "pdb":
        return _under_pdb(copy, str(request["address"]))
    return _under_debugpy(copy, int(request["port"]))


def _under_pdb(copy: Copy, address: str) -> Calls:
    from rsltrace.debug.callback_pdb import call_under_pdb

    def calls(callback: Callable[..., Any], args: tuple[Any, ...]) -> None:
        try:
            raised = call_under_pdb(callback, args, address)
        except BaseException as error:
            copy.end_apart(error={"kind": "DebugError", "message": str(error)})
        copy.end_apart(ok={"ended": "the callback is over", "raised": raised})

    with copy.outside():
        _end_when_told(copy)
    return calls


def _under_debugpy(copy: Copy, port: int) -> Calls:
    from rsltrace.debug.callback_debugpy import HOST, Debugpy

    with copy.outside():
        _end_when_told(copy)
        editor = Debugpy(port, copy.outside)
        text = f"debugpy waits for an editor at {HOST}:{editor.port}"
        copy.lines.send({"notice": "debugpy", "port": editor.port, "text": text})
        editor.wait()
    is_first = [True]

    def calls(callback: Callable[..., Any], args: tuple[Any, ...]) -> None:
        with copy.outside():
            if not editor.is_connected:
                copy.end_apart(ok={"ended": "the editor has disconnected", "raised": ""})
            code = code_of(copy.view.call.callback)
            if is_first and code is not None:
                is_first.clear()
                editor.stop_in(code)
        editor.call(callback, args)

    return calls


def _end_when_told(copy: Copy) -> None:
    """End the copy as soon as somebody says so, or is gone, whatever it does then."""

    def wait() -> None:
        poll = select.poll()  # any descriptor, unlike select
        poll.register(copy.lines, select.POLLIN)
        poll.poll()
        copy.end_apart(ok={"ended": "interrupted", "raised": ""})

    threading.Thread(target=wait, name="rsltrace", daemon=True).start()
