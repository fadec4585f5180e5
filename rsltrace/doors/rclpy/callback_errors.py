"""What becomes of a run in which an event raised: recorded, logged, handed on, or the end of it."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from rsltrace.doors.rclpy.boundary.outside_event import OutsideEvent
from rsltrace.doors.rclpy.error_text import Raised, end_child, exit_status, text_of, user_traceback
from rsltrace.doors.rclpy.stacks.blocking_calls import RunEnded
from rsltrace.errors import OutputError, RsltraceError, RunError
from rsltrace.loop.stop import Stop
from rsltrace.model.event import EventFlag, EventKind, OutputKind
from rsltrace.trace.chain import hash64

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core
    from rsltrace.loop.loop import Dispatchable

_RAISED = int(EventFlag.RAISED)
_LIFE = frozenset((EventKind.CONSTRUCT, EventKind.SHUTDOWN, EventKind.CLOCK_JUMP))
_ERROR = 40


def failed(core: Core, error: BaseException, handle: Dispatchable) -> None:
    """Record what the event under way raised, and decide what becomes of the run.

    :raises OutputError: the trace cannot be written; no event may be lost quietly.
    """
    if isinstance(error, RunEnded):
        return
    if isinstance(error, OutputError):
        raise error
    if os.getpid() != core.process:
        end_child(error)
    core.flags |= _RAISED
    node = core.current_node.fully_qualified_name if core.current_node is not None else ""
    text = user_traceback(error)
    raised = Raised(error, handle.describe(), node, core.loop.now_ns, text, text_of(error))
    _record(core, raised)
    goes_on = _goes_on(core, error)
    if _belongs_to_executor(handle) and not goes_on:
        # It comes out of the spin of whoever runs the callback; what becomes of it is theirs.
        core.raised = error
        core.program.failures.append(raised)
    elif isinstance(error, SystemExit):
        reason = f"{raised.label} raised SystemExit"
        if error.code is not None and not isinstance(error.code, int):
            reason += f": {raised.said}"  # what Python would print
        core.loop.stop(Stop(reason, exit_status(error)))
    elif isinstance(error, KeyboardInterrupt):
        core.loop.stop(Stop("interrupted", 130))
    elif goes_on:
        assert core.current_node is not None
        message = f"{raised.label} raised {raised.kind}: {raised.said}"
        core.logs.log(_ERROR, core.current_node.logger_name(), message, "", "", 0)
    else:
        core.error = _run_error(core, raised)
        core.error.__cause__ = error
        core.loop.stop(Stop(f"{raised.label} raised {raised.kind}", core.error.exit_code))


def _record(core: Core, raised: Raised) -> None:
    if core.recorder is not None:
        content = hash64(f"{raised.kind}\0{raised.said}".encode())
        core.recorder.detail(
            OutputKind.EXCEPTION, core.current_entity, raised.stamp_ns, raised.traceback, content
        )


def _run_error(core: Core, raised: Raised) -> RunError:
    earlier = next((one for one in core.program.failures if one.error is raised.error), None)
    if earlier is not None:
        return earlier.as_error()  # a callback's, which has come out of its main
    error = raised.error
    if not isinstance(error, RsltraceError):
        return raised.as_error()
    # Raised by the middleware itself: the message says what to do, this says where.
    failure = type(error).__new__(type(error))
    failure.__dict__.update(error.__dict__)
    Exception.__init__(failure, f"{raised.said}\n  in {raised.where}")
    return failure if isinstance(failure, RunError) else RunError(str(failure))


def _belongs_to_executor(handle: Any) -> bool:
    """Say whether an event was run by an executor of the user's own."""
    if isinstance(handle, OutsideEvent):
        return False
    mailbox = getattr(handle, "mailbox", None)
    if mailbox is None and getattr(handle, "node", None) is not None:
        mailbox = handle.node.mailbox
    return mailbox is not None


def _goes_on(core: Core, error: BaseException) -> bool:
    """Say whether an exception is only logged: of a callback whose job entry says so.

    What rsltrace itself refuses always ends the run; so does a node that was never made.
    """
    node = core.current_node
    if node is None or not node.log_exceptions or core.kind in _LIFE:
        return False
    return isinstance(error, Exception) and not isinstance(error, RsltraceError)
