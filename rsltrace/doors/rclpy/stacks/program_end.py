"""How a main ends: by returning, by ``sys.exit``, by an exception, or because the run is over.

When the run is over, every main that still waits is told as ``ros2 launch`` tells a node: its
contexts are shut down and the call that blocks raises ``KeyboardInterrupt``. What it does then
(``finally`` blocks, joining threads) runs to its end, while simulated time stands still.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

from greenlet import getcurrent

from rsltrace.doors.rclpy.error_text import exit_status, text_of
from rsltrace.doors.rclpy.stacks.blocking_calls import RunEnded, Wait
from rsltrace.doors.rclpy.stacks.exit_handlers import run_exit_handlers
from rsltrace.doors.rclpy.stacks.threads import SimThread
from rsltrace.loop.stop import Stop
from rsltrace.model.event import OutputKind
from rsltrace.model.stamp import format_seconds

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core
    from rsltrace.doors.rclpy.stacks.program import Program

_EVERY_MAIN_ENDED = "every main has ended"


def end_program(program: Program, error: BaseException | None) -> None:
    """Do what the end of a process does, within the last event of its main.

    An exception that nobody caught is raised again: it fails the run, except while that ends.
    """
    core = program.core
    program.ended = True
    _stop_threads(program)
    failed = _judge(program, error)
    idle = [node.fully_qualified_name for node in _nodes(program) if node.wrapper is None]
    at = format_seconds(core.loop.now_ns)
    if not core.ending and not core.closing and not failed and not program.exit_code:
        if not program.spun:
            never = f": no callback of {', '.join(idle)} has run" if idle else ""
            core.notes.append(f"{program.name} ended at {at} s without ever spinning{never}")
        else:
            core.notes.append(f"{program.name} ended at {at} s")
    _vanish(program)
    if failed:
        assert error is not None
        raise error
    alone = not core.fed and all(node.program is not core.host for node in core.graph.nodes)
    if alone and core.loop.stopped is None and all(other.ended for other in core.programs):
        core.loop.stop(Stop(_EVERY_MAIN_ENDED))


def finish_process(program: Program, error: BaseException | None) -> None:
    """Do what Python does when main is over: wait for its threads, run its exit handlers.

    A main that fails ends the run at once instead.
    """
    if error is None or isinstance(error, (SystemExit, KeyboardInterrupt)):
        _wait_for_threads(program)
        run_exit_handlers(program)


def _wait_for_threads(program: Program) -> None:
    """Wait for all threads that are no daemons, as a process does when its main has returned."""
    own = [t for t in program.core.threads if t.program is program and not t.ended]
    with contextlib.suppress(RunEnded, KeyboardInterrupt):
        for thread in own:
            thread.dismiss()
        for thread in own:
            if not thread.daemon:
                thread.join(None)


def _stop_threads(program: Program) -> None:
    """Unwind the threads that are left: they end with their process."""
    for blocked in list(program.core.blocked):
        if blocked.program is program:
            blocked.error = RunEnded()
            blocked.release()


def _judge(program: Program, error: BaseException | None) -> bool:
    """Take note of how main ended; return whether that fails the run."""
    core = program.core
    if error is None or isinstance(error, RunEnded):
        return False
    over = core.closing or core.ending
    if isinstance(error, SystemExit):
        program.exit_code = exit_status(error)
        core.note(OutputKind.SHUTDOWN, 0, 1, program.exit_code)
        if program.exit_code:
            said = "" if isinstance(error.code, int) else f": {text_of(error)}"
            at = format_seconds(core.loop.now_ns)
            core.notes.append(f"{program.name} exited with {program.exit_code} at {at} s{said}")
        return False
    if over:
        if not isinstance(error, KeyboardInterrupt) and not _is_external_shutdown(error):
            kind = type(error).__qualname__
            core.notes.append(f"{program.name}, told to end, raised {kind}: {text_of(error)}")
        return False
    return True


def _is_external_shutdown(error: BaseException) -> bool:
    from rclpy.executors import ExternalShutdownException

    return isinstance(error, ExternalShutdownException)


def _nodes(program: Program) -> list[Any]:
    return [node for node in program.core.graph.nodes if node.program is program]


def _vanish(program: Program) -> None:
    """Take a process's nodes out of the graph, as its end does."""
    for context in program.contexts:
        context.end()
    for node in _nodes(program):
        if node.mailbox is not None:
            node.mailbox.close()
        for endpoint in program.core.graph.endpoints_of(node):
            endpoint.destroy_when_not_in_use()
        node.destroy_when_not_in_use()


def end_programs(core: Core) -> None:
    """Tell every main that is still there to end, and let it."""
    if core.closing or not core.programs:
        return
    core.closing = True
    core.loop.halt()
    for program in core.programs:
        if not program.ended and program.begun:
            _interrupt(program)
            _let_run(program)


def _interrupt(program: Program) -> None:
    for context in program.contexts:
        context.end()
    blocked = program.blocked()
    if blocked is not None:
        blocked.error = KeyboardInterrupt()
        blocked.release()
    for other in list(program.core.blocked):
        if other.program is program and other.quiet:
            other.release()


def _let_run(program: Program) -> None:
    """Let a program end that has been told to, as long as ros2 launch leaves it.

    Time stands still meanwhile: who sleeps goes on when nobody else can.
    """
    core = program.core
    loop = core.loop
    core.grace_ns = 0
    while not program.ended:
        item = loop.tasks.popleft() if loop.tasks else loop.ready.popleft() if loop.ready else None
        if isinstance(item, Wait):
            core.runners.append(getcurrent())
            item.stack.switch()
        elif isinstance(item, SimThread):
            item.dispatch()
        elif item is None:
            timed = [(w.deadline_ns, w) for w in core.blocked if w.deadline_ns and w.waiting]
            own = [pair for pair in timed if pair[1].program is program]
            if not own:
                return
            deadline_ns, first = min(own, key=lambda pair: pair[0])
            core.grace_ns = max(deadline_ns - loop.now_ns, core.grace_ns + 1)
            if core.grace_ns > _GRACE_NS:
                return
            first.time_out()


_GRACE_NS = 10_000_000_000
