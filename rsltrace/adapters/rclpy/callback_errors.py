"""What becomes of a run in which user code raised: handed on, logged, or the end of it."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import NoReturn

from rsltrace.adapters.rclpy.handles.logs import Logs
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.hints import hint_for
from rsltrace.adapters.rclpy.stacks.mailbox import Mailbox, mailbox_of
from rsltrace.adapters.rclpy.stacks.runners import RunEnded, Stacks
from rsltrace.errors import RsltraceError, RunError
from rsltrace.simulation.loop.loop import Dispatchable
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.event import OutsideEvent
from rsltrace.simulation.middleware.events.failure import (
    Raised,
    described,
    end_run,
    note_raised,
    text_of,
    user_traceback,
)
from rsltrace.terminal import tell
from rsltrace.trace.model.event import EventKind

# The exit status that an exception asks for, and how a forked process ends by one.


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


_LIFE = frozenset((EventKind.CONSTRUCT, EventKind.SHUTDOWN, EventKind.CLOCK_JUMP))
_ERROR = 40


class RclpyDoor:
    """The door of rclpy's nodes, and of all that the job constructs."""

    def __init__(self, stacks: Stacks, logs: Logs) -> None:
        self._stacks = stacks
        self._logs = logs

    def raised(self, error: BaseException, handle: Dispatchable) -> None:
        """Record what the event under way raised, and decide what becomes of the run."""
        stacks = self._stacks
        if isinstance(error, RunEnded):
            if not (stacks.ending.closing and isinstance(error.__context__, KeyboardInterrupt)):
                return
            error = error.__context__  # it was told to end, and cut off while it saw to that
        if os.getpid() != stacks.runners.process:
            end_child(error)
        told_to_end = stacks.ending.closing and isinstance(error, KeyboardInterrupt)
        note = described if told_to_end else note_raised
        raised = note(stacks.dispatcher, error, handle)
        mailbox = None if isinstance(handle, OutsideEvent) else mailbox_of(handle)
        node = self._who_goes_on(error)
        if mailbox is not None and node is None:
            self._hand_on(mailbox, raised)
        elif isinstance(error, SystemExit):
            reason = f"{raised.label} raised SystemExit"
            if error.code is not None and not isinstance(error.code, int):
                reason += f": {raised.said}"  # what Python would print
            stacks.loop.stop(Stop(reason, exit_status(error)))
        elif isinstance(error, KeyboardInterrupt):
            stacks.loop.stop(Stop("interrupted", 130))
        elif node is not None:
            message = f"{raised.label} raised {raised.kind}: {raised.said}"
            self._logs.log(_ERROR, node.logger_name(), message, "", "", 0)
        else:
            end_run(stacks.dispatcher, raised, self._run_error(raised))

    def _hand_on(self, mailbox: Mailbox, raised: Raised) -> None:
        """Let an exception come out of the spin of whoever runs the callback: it is theirs."""
        mailbox.raised = raised.error
        self._stacks.programs.present.failures.append(raised)

    def _run_error(self, raised: Raised) -> RunError:
        failures = self._stacks.programs.present.failures
        earlier = next((one for one in failures if one.error is raised.error), None)
        if earlier is not None:
            return earlier.as_error(hint_for(earlier.error))  # has come out of its main
        error = raised.error
        if not isinstance(error, RsltraceError):
            return raised.as_error(hint_for(error))
        # Raised by the middleware itself: the message says what to do, this says where.
        failure = type(error).__new__(type(error))
        failure.__dict__.update(error.__dict__)
        Exception.__init__(failure, f"{raised.said}\n  in {raised.where}")
        return failure if isinstance(failure, RunError) else RunError(str(failure))

    def _who_goes_on(self, error: BaseException) -> NodeHandle | None:
        """Return the node whose callback's exception is only logged: its job entry says so.

        What rsltrace itself refuses always ends the run; so does a node that was never made.
        """
        event = self._stacks.event
        node = event.node
        if not isinstance(node, NodeHandle) or not node.log_exceptions or event.kind in _LIFE:
            return None
        is_logged = isinstance(error, Exception) and not isinstance(error, RsltraceError)
        return node if is_logged else None
