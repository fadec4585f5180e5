"""Begin and end of mains: by returning, by ``sys.exit``, by an exception, or with the run.

When the run is over, waiting mains are interrupted as by ``ros2 launch``: contexts are shut down,
and the blocking call raises ``KeyboardInterrupt``. ``finally`` blocks and joins of threads then run
to their end, while simulated time stands still.
"""

from __future__ import annotations

import atexit
import contextlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from greenlet import getcurrent, greenlet

from rsltrace.adapters.rclpy.callback_errors import exit_status
from rsltrace.adapters.rclpy.concurrency.blocking_calls import calling_runtime
from rsltrace.adapters.rclpy.concurrency.entry_starts import ConstructionEvent
from rsltrace.adapters.rclpy.concurrency.program import ExitHandler, SimulatedProgram
from rsltrace.adapters.rclpy.concurrency.runtime import BlockedCall, RunEnded, Runtime
from rsltrace.adapters.rclpy.concurrency.threads import SimThread
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.failure import as_printed, exception_text
from rsltrace.trace.model.event import NO_EVENT, EventKind, OutputKind
from rsltrace.trace.model.texts import format_seconds


@contextmanager
def own_exit_handlers(runtime: Runtime) -> Iterator[None]:
    """Give each main its own ``atexit`` handlers, which run when it ends."""
    real_register, real_unregister = atexit.register, atexit.unregister

    def of_main() -> list[ExitHandler] | None:
        if calling_runtime() is runtime and not runtime.programs.is_hosted:
            return runtime.programs.present.exit_handlers
        return None

    def register(function: Any, /, *args: Any, **kwargs: Any) -> Any:
        handlers = of_main()
        if handlers is None:
            return real_register(function, *args, **kwargs)
        handlers.append((function, args, kwargs))
        return function

    def unregister(function: Any, /) -> None:
        handlers = of_main()
        if handlers is None:
            real_unregister(function)
        else:
            handlers[:] = [handler for handler in handlers if handler[0] != function]

    atexit.register, atexit.unregister = register, unregister
    try:
        yield
    finally:
        atexit.register, atexit.unregister = real_register, real_unregister


def run_exit_handlers(program: SimulatedProgram) -> None:
    """Run a main's exit handlers, the last first, as Python does."""
    while program.exit_handlers:
        function, args, kwargs = program.exit_handlers.pop()
        function(*args, **kwargs)


_EVERY_MAIN_ENDED = "every main has ended"
_INTERRUPTED = 130
"""The exit status of a process that SIGINT has ended."""


def begin_program(
    runtime: Runtime, program: SimulatedProgram, cause: tuple[int, int] = (NO_EVENT, 0)
) -> None:
    """Run a main until it ends or first blocks, as one event; ``cause``: its event and output."""
    entities = runtime.domain.entities
    program.begun_ns = runtime.loop.now_ns
    program.entity_id = entities.new_id()
    entities.pending.append(program)

    def body() -> None:
        program.enter()
        event = ConstructionEvent(program.describe, program.entry)
        runtime.dispatcher.run_outside(
            event,
            EventKind.CONSTRUCT,
            program.entity_id,
            None,
            lambda: _run(runtime, program),
            cause,
        )
        runtime.programs.host.enter()
        runtime.runners.step_aside()

    runtime.runners.waiting.append(getcurrent())
    program.stack = greenlet(body)
    program.stack.switch()


def _run(runtime: Runtime, program: SimulatedProgram) -> None:
    assert program.entry is not None
    error: BaseException | None = None
    runtime.programs.tell("started", program.entry.key)
    try:
        status = program.entry.make()
        if status is not None:  # a console script is sys.exit(main())
            raise SystemExit(status)
    except BaseException as raised:
        error = raised
    try:
        _finish_process(runtime, program, error)
    except BaseException as raised:
        error = raised
    end_program(runtime, program, error)


def end_program(runtime: Runtime, program: SimulatedProgram, error: BaseException | None) -> None:
    """End a process, within the last event of its main.

    An uncaught exception is raised again and fails the run, unless the run is ending.
    """
    notes = runtime.domain.outcome.notes
    program.ended = True
    _stop_threads(runtime, program)
    failed = _note_main_end(runtime, program, error)
    idle = [node.fully_qualified_name for node in _nodes(runtime, program) if node.wrapper is None]
    at = format_seconds(runtime.loop.stamp)
    ending = runtime.ending
    if not (ending.unwinding or ending.closing or failed or program.exit_code):
        if not program.spun:
            never = f": no callback of {', '.join(idle)} has run" if idle else ""
            notes.append(f"{program.label} ended at {at} s without ever spinning{never}")
        else:
            notes.append(f"{program.label} ended at {at} s")
    _destroy_nodes(runtime, program)
    if failed:
        assert error is not None
        raise error
    _has_ended(runtime, program)


def _has_ended(runtime: Runtime, program: SimulatedProgram) -> None:
    """Announce the end of a process; with the last one the run may be over."""
    programs = runtime.programs
    assert program.entry is not None
    programs.tell("ended", program.entry.key)
    mains = programs.all
    alone = not (programs.fed or programs.to_come) and all(
        node.process in mains for node in runtime.domain.graph.nodes
    )
    if alone and runtime.loop.stopped is None and all(other.ended for other in mains):
        runtime.loop.stop(Stop(_EVERY_MAIN_ENDED))


def crash_program(runtime: Runtime, program: SimulatedProgram) -> None:
    """End a process in the current event; ``FaultedNodes`` has stopped its nodes."""
    for context in program.contexts:
        context.end()
    program.ended = True
    at = format_seconds(runtime.loop.stamp)
    runtime.domain.outcome.notes.append(f"{program.label} crashed at {at} s, as the job says")
    _has_ended(runtime, program)


def _finish_process(
    runtime: Runtime, program: SimulatedProgram, error: BaseException | None
) -> None:
    """Wait for threads and run exit handlers, as Python does after main, unless main failed."""
    if error is None or isinstance(error, (SystemExit, KeyboardInterrupt)):
        _wait_for_threads(runtime, program)
        run_exit_handlers(program)


def _wait_for_threads(runtime: Runtime, program: SimulatedProgram) -> None:
    """Wait for all threads that are not daemons; they may start more meanwhile."""
    with contextlib.suppress(RunEnded, KeyboardInterrupt):
        while True:
            own = [t for t in runtime.threads.alive if t.program is program and not t.ended]
            for thread in own:
                thread.dismiss()
            if all(thread.daemon for thread in own):
                break
            for thread in own:
                if not thread.daemon:
                    thread.join(None)


def _stop_threads(runtime: Runtime, program: SimulatedProgram) -> None:
    """Unwind the remaining threads."""
    for blocked in list(runtime.runners.blocked):
        if blocked.program is program:
            blocked.error = RunEnded()
            blocked.release()


def _note_main_end(
    runtime: Runtime, program: SimulatedProgram, error: BaseException | None
) -> bool:
    """Note how a main ended; return whether that fails the run."""
    is_return = isinstance(error, SystemExit) and error.code is None  # sys.exit(main())
    if error is None or is_return or isinstance(error, RunEnded):
        return False
    notes = runtime.domain.outcome.notes
    over = runtime.ending.closing or runtime.ending.unwinding
    if isinstance(error, SystemExit) or (isinstance(error, KeyboardInterrupt) and not over):
        program.exit_code = exit_status(error) if isinstance(error, SystemExit) else _INTERRUPTED
        runtime.dispatcher.note(OutputKind.SHUTDOWN, 0, 1, program.exit_code)
        if program.exit_code:
            said = exception_text(error) if not isinstance(getattr(error, "code", 0), int) else ""
            said = f": {said}" if said else ""
            at = format_seconds(runtime.loop.stamp)
            notes.append(f"{program.label} exited with {program.exit_code} at {at} s{said}")
        return False
    if over:
        if not isinstance(error, KeyboardInterrupt) and not _is_external_shutdown(error):
            raised = as_printed(type(error).__qualname__, exception_text(error))
            notes.append(f"{program.label} raised at the end of the run: {raised}")
        return False
    return True


def _is_external_shutdown(error: BaseException) -> bool:
    from rclpy.executors import ExternalShutdownException

    return isinstance(error, ExternalShutdownException)


def _nodes(runtime: Runtime, program: SimulatedProgram) -> list[Any]:
    return [node for node in runtime.domain.graph.nodes if node.process is program]


def _destroy_nodes(runtime: Runtime, program: SimulatedProgram) -> None:
    """Take a process's nodes out of the graph."""
    for context in program.contexts:
        context.end()
    for node in _nodes(runtime, program):
        if node.mailbox is not None:
            node.mailbox.close()
        for endpoint in runtime.domain.graph.endpoints_of(node):
            endpoint.destroy()
        node.destroy()


def end_programs(runtime: Runtime) -> None:
    """Interrupt every main that still runs, and let it end."""
    if runtime.ending.closing or not runtime.programs.all:
        return
    runtime.ending.closing = True
    runtime.loop.halt()
    for program in runtime.programs.all:
        if not program.ended and program.begun_ns is not None:
            interrupt(runtime, program)
            _let_run(runtime, program)


def interrupt(runtime: Runtime, program: SimulatedProgram) -> None:
    """Act as SIGINT on a process: the blocking call of its main raises ``KeyboardInterrupt``. (If
    there is none, the caller raises it.)"""
    if program.shuts_down_on("SIGINT"):
        shut_down(runtime, program)
    blocked = next((one for one in runtime.runners.blocked if one.stack is program.stack), None)
    if blocked is not None:
        blocked.error = KeyboardInterrupt()
        blocked.release()


def shut_down(runtime: Runtime, program: SimulatedProgram) -> None:
    """Shut a process's contexts down, as rclpy's signal handler does."""
    for context in program.contexts:
        context.end()
    for other in list(runtime.runners.blocked):
        if other.program is program and other.quiet:
            other.release()


def _let_run(runtime: Runtime, program: SimulatedProgram) -> None:
    """Let an interrupted program end, for as long as ros2 launch waits.

    Time stands still meanwhile: a sleep is over when nothing else can run.
    """
    loop = runtime.loop
    runtime.ending.grace_ns = 0
    while not program.ended:
        item = loop.tasks.popleft() if loop.tasks else loop.ready.popleft() if loop.ready else None
        if isinstance(item, BlockedCall):
            runtime.runners.waiting.append(getcurrent())
            item.stack.switch()
        elif isinstance(item, SimThread):
            item.dispatch()
        elif item is None:
            timed = [
                (w.deadline_ns, w) for w in runtime.runners.blocked if w.deadline_ns and w.waiting
            ]
            own = [pair for pair in timed if pair[1].program is program]
            if not own:
                return
            deadline_ns, first = min(own, key=lambda pair: pair[0])
            runtime.ending.grace_ns = max(deadline_ns - loop.now_ns, runtime.ending.grace_ns + 1)
            if runtime.ending.grace_ns > _GRACE_NS:
                return
            first.time_out()


_GRACE_NS = 10_000_000_000
