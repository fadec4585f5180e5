"""A callback that raised: what it says, how it is recorded, and the plain way it ends a run.

User exceptions can be anything: ``__str__`` may raise, and texts may hold what no file can.
"""

from __future__ import annotations

import contextlib
import traceback
from dataclasses import dataclass
from pathlib import Path

from rsltrace.errors import NodeError, RunError
from rsltrace.loop.loop import Dispatchable
from rsltrace.loop.stop import Stop
from rsltrace.middleware.dispatcher import Dispatcher
from rsltrace.model.event import EventFlag, OutputKind
from rsltrace.model.stamp import format_seconds
from rsltrace.trace.chain import hash64

_RAISED = int(EventFlag.RAISED)
_PACKAGE = str(Path(__file__).resolve().parents[1])


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

    def as_error(self, hint: str = "") -> NodeError:
        """Return the error with which the run ends because of it."""
        return NodeError(
            f"{self.where} raised {self.kind}: {self.said}{hint}",
            node=self.node,
            entity=self.label,
            stamp_ns=self.stamp_ns,
            traceback_text=self.traceback,
        )


def note_raised(dispatcher: Dispatcher, error: BaseException, handle: Dispatchable) -> Raised:
    """Record that the event under way has raised, as one of its outputs; return how."""
    event, recorder = dispatcher.event, dispatcher.recorder
    event.flags |= _RAISED
    node = event.node.fully_qualified_name if event.node is not None else ""
    stamp_ns = dispatcher.loop.now_ns
    raised = Raised(error, handle.describe(), node, stamp_ns, user_traceback(error), text_of(error))
    if recorder is not None:
        content = hash64(f"{raised.kind}\0{raised.said}".encode())
        recorder.detail(
            OutputKind.EXCEPTION, event.entity, raised.stamp_ns, raised.traceback, content
        )
    return raised


def end_run(dispatcher: Dispatcher, raised: Raised, error: RunError) -> None:
    """End the run after the present event, because of what it has raised."""
    dispatcher.outcome.error = error
    error.__cause__ = raised.error
    dispatcher.loop.stop(Stop(f"{raised.label} raised {raised.kind}", error.exit_code))


class FailuresEndTheRun:
    """The door of participants that have no other: what they raise ends the run."""

    def __init__(self, dispatcher: Dispatcher) -> None:
        self._dispatcher = dispatcher

    def raised(self, error: BaseException, handle: Dispatchable) -> None:
        raised = note_raised(self._dispatcher, error, handle)
        end_run(self._dispatcher, raised, raised.as_error())


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
