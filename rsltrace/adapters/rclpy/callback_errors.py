"""Exceptions of user code: passed on to a spin, logged, or the end of the run."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import NoReturn

from rsltrace.adapters.rclpy.concurrency.mailbox import Mailbox, mailbox_of
from rsltrace.adapters.rclpy.concurrency.runtime import RunEnded, Runtime
from rsltrace.adapters.rclpy.handles.logs import RosoutLogs
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.hints import hint_for
from rsltrace.errors import RsltraceError, RunError
from rsltrace.simulation.loop.loop import Dispatchable
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.event import OutsideEvent
from rsltrace.simulation.middleware.events.failure import (
    RaisedException,
    describe_exception,
    end_run,
    exception_text,
    record_exception,
    user_traceback,
)
from rsltrace.terminal import tell
from rsltrace.trace.model.event import EventKind

# The exit status that an exception asks for, and how a forked process ends by one.


def exit_status(error: SystemExit) -> int:
    """Return Python's exit status."""
    if error.code is None:
        return 0
    return int(error.code) if isinstance(error.code, int) else 1


def end_child(error: BaseException) -> NoReturn:
    """End a forked process whose callback raised: only the parent process runs the simulation."""
    if not isinstance(error, SystemExit):
        tell(user_traceback(error), end="")
    elif error.code is not None and not isinstance(error.code, int):
        tell(exception_text(error))
    with contextlib.suppress(Exception):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit((exit_status(error) if isinstance(error, SystemExit) else 1) & 0xFF)


_LIFE = frozenset((EventKind.CONSTRUCT, EventKind.SHUTDOWN, EventKind.CLOCK_JUMP))
_ERROR = 40


class RclpyExceptionHandler:
    """Handles exceptions of rclpy's nodes, and of everything that the job constructs."""

    def __init__(self, runtime: Runtime, logs: RosoutLogs) -> None:
        self._runtime = runtime
        self._logs = logs

    def raised(self, error: BaseException, handle: Dispatchable) -> None:
        """Record an exception of the current event, and decide how the run goes on."""
        runtime = self._runtime
        if isinstance(error, RunEnded):
            if not (runtime.ending.closing and isinstance(error.__context__, KeyboardInterrupt)):
                return
            error = error.__context__  # interrupted, and cut off while it cleaned up
        if os.getpid() != runtime.runners.process:
            end_child(error)
        is_ending = runtime.ending.closing and isinstance(error, KeyboardInterrupt)
        note = describe_exception if is_ending else record_exception
        raised = note(runtime.dispatcher, error, handle)
        mailbox = None if isinstance(handle, OutsideEvent) else mailbox_of(handle)
        node = self._logging_node(error)
        if mailbox is not None and node is None:
            self._hand_on(mailbox, raised)
        elif isinstance(error, SystemExit):
            reason = f"{raised.label} raised SystemExit"
            if error.code is not None and not isinstance(error.code, int):
                reason += f": {raised.said}"  # as Python prints it
            runtime.loop.stop(Stop(reason, exit_status(error)))
        elif isinstance(error, KeyboardInterrupt):
            runtime.loop.stop(Stop("interrupted", 130))
        elif node is not None:
            message = f"{raised.label} raised {raised.kind}: {raised.said}"
            self._logs.log(_ERROR, node.logger_name(), message, "", "", 0)
        else:
            end_run(runtime.dispatcher, raised, self._run_error(raised))

    def _hand_on(self, mailbox: Mailbox, raised: RaisedException) -> None:
        """Raise an exception out of the spin that runs the callback."""
        mailbox.raised = raised.error
        self._runtime.programs.present.failures.append(raised)

    def _run_error(self, raised: RaisedException) -> RunError:
        failures = self._runtime.programs.present.failures
        earlier = next((one for one in failures if one.error is raised.error), None)
        if earlier is not None:
            return earlier.as_error(hint_for(earlier.error))  # its main raised it again
        error = raised.error
        if not isinstance(error, RsltraceError):
            return raised.as_error(hint_for(error))
        # Raised by the middleware itself: its message has no place, so add one.
        failure = type(error).__new__(type(error))
        failure.__dict__.update(error.__dict__)
        Exception.__init__(failure, f"{raised.said}\n  in {raised.where}")
        return failure if isinstance(failure, RunError) else RunError(str(failure))

    def _logging_node(self, error: BaseException) -> NodeHandle | None:
        """Return the node whose exceptions are only logged, as its job entry says.

        rsltrace's own errors and exceptions of constructors always end the run.
        """
        event = self._runtime.event
        node = event.node
        if not isinstance(node, NodeHandle) or not node.log_exceptions or event.kind in _LIFE:
            return None
        is_logged = isinstance(error, Exception) and not isinstance(error, RsltraceError)
        return node if is_logged else None
