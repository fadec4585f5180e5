"""A callback that raised: its text, how it is recorded, and how it ends a run.

User exceptions can be anything: ``__str__`` may raise, and texts may hold what no file can.
"""

from __future__ import annotations

import contextlib
import os
import traceback
from collections import deque
from pathlib import Path
from types import FrameType, TracebackType

from rsltrace.errors import NodeError, RsltraceError, RunError
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.loop.loop import Dispatchable
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.event import EventFlag, OutputKind
from rsltrace.trace.model.texts import format_seconds

_RAISED = int(EventFlag.RAISED)
_FRAMES_MAX = 5000
"""So many are kept of each end of a traceback."""
_OWN_FILES = (
    os.path.join(Path(__file__).resolve().parents[3], ""),  # this package
    "<serialize ",  # the code that is made for a message type
    "<deserialize ",
)


@dataclass(frozen=True, slots=True)
class RaisedException:
    """An exception of an event.

    ``label`` names the event, ``node`` is the full name or "", ``stamp_ns`` simulated time,
    ``traceback`` has the user's frames and ``said`` is the exception's text.
    """

    error: BaseException
    label: str
    node: str
    stamp_ns: int
    traceback: str
    said: str

    @property
    def kind(self) -> str:
        return type(self.error).__qualname__

    @property
    def where(self) -> str:
        return f"{self.label}, at simulated time {format_seconds(self.stamp_ns)} s"

    def as_error(self, hint: str = "") -> NodeError:
        return NodeError(
            f"{self.where} raised {as_printed(self.kind, self.said)}{hint}",
            node=self.node,
            entity=self.label,
            stamp_ns=self.stamp_ns,
            traceback_text=self.traceback,
        )


def describe_exception(
    dispatcher: Dispatcher, error: BaseException, handle: Dispatchable
) -> RaisedException:
    node = dispatcher.event.node
    return RaisedException(
        error,
        handle.describe(),
        node.fully_qualified_name if node is not None else "",
        dispatcher.loop.stamp,
        user_traceback(error),
        exception_text(error),
    )


def record_exception(
    dispatcher: Dispatcher, error: BaseException, handle: Dispatchable
) -> RaisedException:
    """Record that the current event raised, as one of its outputs; return the description."""
    event, recorder = dispatcher.event, dispatcher.recorder
    event.flags |= _RAISED
    raised = describe_exception(dispatcher, error, handle)
    if recorder is not None:
        content = hash64(f"{raised.kind}\0{raised.said}".encode())
        recorder.detail(
            OutputKind.EXCEPTION, event.entity, raised.stamp_ns, raised.traceback, content
        )
    return raised


def end_run(dispatcher: Dispatcher, raised: RaisedException, error: RunError) -> None:
    """End the run because of an exception."""
    dispatcher.outcome.error = error
    error.__cause__ = raised.error
    reason = f"{raised.label} raised {raised.kind}"
    if isinstance(raised.error, RsltraceError):  # its type is a name of ours
        reason = str(error).split("\n", 1)[0]
    dispatcher.loop.stop(Stop(reason, error.exit_code))


class RunEndingExceptionHandler:
    """Ends the run at any exception."""

    def __init__(self, dispatcher: Dispatcher) -> None:
        self._dispatcher = dispatcher

    def raised(self, error: BaseException, handle: Dispatchable) -> None:
        raised = record_exception(self._dispatcher, error, handle)
        end_run(self._dispatcher, raised, raised.as_error())


def as_printed(kind: str, said: str) -> str:
    """Return type and text of an exception as Python prints them: ``KeyError: 'x'``."""
    return f"{kind}: {said}" if said else kind


def exception_text(error: BaseException) -> str:
    """Return an exception's text, in a form that can be written to any file."""
    try:
        return _writable(str(error))
    except Exception:
        return "(its text could not be made)"


def _writable(text: str) -> str:
    return text.encode("utf-8", "backslashreplace").decode()


def is_own_frame(frame: FrameType) -> bool:
    return frame.f_code.co_filename.startswith(_OWN_FILES)


def user_traceback(error: BaseException) -> str:
    """Return the traceback without rsltrace's frames, if others remain."""
    if isinstance(error, NodeError) and error.traceback_text:  # of a process
        return f"{error.traceback_text}{type(error).__qualname__}: {error}\n"
    with contextlib.suppress(Exception):
        left_out = sum(map(_shorten, (error, error.__cause__, error.__context__)))
        summary = traceback.TracebackException(
            type(error), error, error.__traceback__, compact=True
        )
        if not all(map(_is_own_line, summary.stack)):
            _leave_out_own(summary)
        text = _writable("".join(summary.format()))
        return f"{left_out} frames of a recursion are left out\n{text}" if left_out else text
    return f"{type(error).__qualname__} (its text could not be made)"


def _shorten(error: BaseException | None) -> int:
    """Cut the middle out of the traceback of a very deep recursion, and return how many frames that
    were: Python makes a text of a million in minutes, and takes no Ctrl-C meanwhile."""
    head = None if error is None else error.__traceback__
    count, tail, at = 0, deque[TracebackType](maxlen=_FRAMES_MAX), head
    while at is not None:
        count += 1
        tail.append(at)
        head = at if count == _FRAMES_MAX else head
        at = at.tb_next
    left_out = max(count - 2 * _FRAMES_MAX, 0)
    if left_out and head is not None:
        head.tb_next = tail[0]
    return left_out


def _is_own_line(line: traceback.FrameSummary) -> bool:
    return line.filename.startswith(_OWN_FILES)


def _leave_out_own(summary: traceback.TracebackException | None) -> None:
    while summary is not None:
        summary.stack = traceback.StackSummary.from_list(
            [line for line in summary.stack if not _is_own_line(line)]
        )
        for one in getattr(summary, "exceptions", None) or ():  # of a group, from Python 3.11 on
            _leave_out_own(one)
        _leave_out_own(summary.__context__)
        summary = summary.__cause__
