"""Python debuggers that call the callbacks in copies of a simulation."""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import CodeType, FrameType
from typing import Any, Protocol

from rsltrace.debug.current_event import CurrentEventView, code_of
from rsltrace.errors import DebugError
from rsltrace.line_protocol import Lines, Message

# Debugpy's threads, locks and sleeps have to be real ones, even on the stack of a stopped callback.
# ``Outside`` is the context in which they are not part of the run.

HOST = "127.0.0.1"
_BREAKPOINT = 1_000_000_000
_SETTINGS = {
    "PYDEVD_DISABLE_FILE_VALIDATION": "1",  # or it says a word about frozen modules
    "PYDEVD_USE_SYS_MONITORING": "0",  # sys.settrace, which can leave out code
    "PYDEVD_USE_FRAME_EVAL": "NO",
}

Trace = Callable[[FrameType, str, Any], Any]
Outside = Callable[[], AbstractContextManager[object]]


class DebugpyServer:
    """An editor's debug adapter in this process. Made and used ``outside`` of the run.

    :raises DebugError: debugpy is missing, or the port is taken.
    """

    def __init__(self, port: int, outside: Outside) -> None:
        for name, value in _SETTINGS.items():
            os.environ.setdefault(name, value)
        try:
            import debugpy
        except ImportError:
            raise DebugError("debugpy is not installed: pip install 'rsltrace[debugpy]'") from None

        self._outside = outside
        self._debugpy: Any = debugpy
        debugpy.configure(subProcess=False)
        try:
            _, self.port = debugpy.listen((HOST, port))
        except (RuntimeError, OSError) as error:
            raise DebugError(f"cannot listen at {HOST}:{port}: {error}") from error
        import pydevd  # debugpy brings its own, once it listens
        import pydevd_tracing

        holder = pydevd_tracing.TracingFunctionHolder
        self._settrace = holder._original_tracing or sys.settrace
        holder._original_tracing = self._trace
        pydevd_tracing.set_trace_to_threads = lambda *args, **more: -1  # there is one
        self._pydb: Any = pydevd.get_global_debugger()
        waits = self._pydb.do_wait_suspend

        def do_wait_suspend(*args: Any, **more: Any) -> Any:
            with outside():
                return waits(*args, **more)

        self._pydb.do_wait_suspend = do_wait_suspend

    def _trace(self, function: Trace | None) -> None:
        """Replace ``sys.settrace``, so that debugpy's own work is not part of the run."""
        self._settrace(None if function is None else self._outside_run(function))

    def _outside_run(self, function: Trace) -> Trace:
        def trace(frame: FrameType, event: str, arg: Any) -> Any:
            with self._outside():
                following = function(frame, event, arg)
            return None if following is None else self._outside_run(following)

        return trace

    @property
    def is_connected(self) -> bool:
        return bool(self._debugpy.is_client_connected())

    def wait(self) -> None:
        self._debugpy.wait_for_client()

    def stop_in(self, code: CodeType) -> None:
        """Set a breakpoint at the first line of a function, for its next call."""
        from _pydevd_bundle.pydevd_api import PyDevdAPI

        PyDevdAPI().add_breakpoint(
            self._pydb,
            code.co_filename,
            "python-line",
            _BREAKPOINT,
            first_line(code),
            None,
            "None",
            None,
            "NONE",
            "@HIT@ == 1",
            False,
        )

    def call(self, callback: Callable[..., Any], args: tuple[Any, ...]) -> None:
        """Call a callback with tracing on, on any stack."""
        with self._outside():
            self._pydb.enable_tracing()
        callback(*args)


def first_line(code: CodeType) -> int:
    lines = {line for _, _, line in code.co_lines() if line}
    return min((line for line in lines if line > code.co_firstlineno), default=code.co_firstlineno)


Calls = Callable[..., None]
"""Takes a callback and its arguments."""


class DebuggedCopy(Protocol):
    """A copy of a simulation, made for a debugger."""

    lines: Lines
    view: CurrentEventView

    def outside(self) -> AbstractContextManager[None]:
        """Do what is no part of the run."""

    def end_apart(self, **answer: Any) -> None:
        """End the copy with an answer."""


def make_debugger(copy: DebuggedCopy, request: Message) -> Calls:
    """Return what calls the next callbacks under the debugger that a request names.

    :raises DebugError: there is none such here.
    """
    if request["do"] == "pdb":
        return _under_pdb(copy, str(request["address"]))
    return _under_debugpy(copy, int(request["port"]))


def _under_pdb(copy: DebuggedCopy, address: str) -> Calls:
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


def _under_debugpy(copy: DebuggedCopy, port: int) -> Calls:
    with copy.outside():
        _end_when_told(copy)
        editor = DebugpyServer(port, copy.outside)
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


def _end_when_told(copy: DebuggedCopy) -> None:
    """End the copy when its client asks for it or disconnects."""

    def wait() -> None:
        poll = select.poll()  # any descriptor, unlike select
        poll.register(copy.lines, select.POLLIN)
        poll.poll()
        copy.end_apart(ok={"ended": "interrupted", "raised": ""})

    threading.Thread(target=wait, name="rsltrace", daemon=True).start()
