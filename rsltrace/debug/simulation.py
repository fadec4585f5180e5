"""The process of a debugged simulation: opens a trace or a job, and serves the supervisor.

Run as ``python -m rsltrace.debug.simulation DESCRIPTOR SPEC`` by the supervisor; DESCRIPTOR is the
socket, SPEC a JSON object.
"""

from __future__ import annotations

import json
import os
import socket
import sys
from contextlib import ExitStack, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsltrace.errors import ReplayError, RsltraceError
from rsltrace.forking import die_with_parent, end_process, other_threads
from rsltrace.guard.pin import pin, unpin
from rsltrace.line_protocol import Lines

if TYPE_CHECKING:
    from rsltrace.debug.event_history import EventHistory
    from rsltrace.job import Job
    from rsltrace.replay.edits import Edit


def main() -> None:
    pin()
    number, spec = int(sys.argv[1]), json.loads(sys.argv[2])
    die_with_parent(spec["supervisor"])
    lines = Lines(socket.socket(fileno=number))
    with ExitStack() as stack:
        try:
            job, history, edits, notes = _opened(spec, stack)
            if not job.guard.pins:
                unpin()
            lines.move_high()
            _serve(job, history, edits, notes, spec, lines, stack)
        except (RsltraceError, OSError) as error:
            from rsltrace.debug.engine import error_answer

            lines.send({"notice": "failed", "error": error_answer(error)})
            end_process(2)


def _opened(
    spec: dict[str, Any], stack: ExitStack
) -> tuple[Job, EventHistory, tuple[Edit, ...], list[str]]:
    """Return the job to run, its event history, the edits in it, and notes."""
    from rsltrace.debug.event_history import RunHistory, TraceHistory
    from rsltrace.diff.file_kind import is_trace

    source = spec["source"]
    if not is_trace(source):
        from rsltrace.job import load_job

        return load_job(Path(source), overrides=spec["overrides"]), RunHistory(), (), []
    from rsltrace.replay.preparation import prepare_replay
    from rsltrace.trace.native import is_native

    folder = spec["job_folder"]
    plan = stack.enter_context(prepare_replay(source, None if folder is None else Path(folder)))
    if plan.distrust and not spec["trust"]:
        raise ReplayError(f"{source} would run code, and {plan.distrust}: give trust=True")
    changed = [f"{one.name} {one.change}" for one in plan.code if one.change]
    history = RunHistory() if is_native(plan.trace) else TraceHistory(plan.trace)
    return plan.job, history, plan.edits, [*plan.notes, *changed]


def _serve(
    job: Job,
    history: EventHistory,
    edits: tuple[Edit, ...],
    notes: list[str],
    spec: dict[str, Any],
    lines: Lines,
    stack: ExitStack,
) -> None:
    from rsltrace.debug.engine import Engine
    from rsltrace.debug.event_history import EventLedger
    from rsltrace.replay.editing import EditObserver
    from rsltrace.run.process import RunCallbacks
    from rsltrace.run.session import RunSession

    idle = _middleware_threads()
    trace = history.trace
    recorded = None
    if trace is not None and job.guard.enabled:
        recorded = Path(os.path.abspath(trace.name))
    ledger = EventLedger(history, ends_at_size_after=None if trace is None else trace.ended_after)
    session = stack.enter_context(
        RunSession(
            job,
            None,
            echo=spec["echo"],
            replay=recorded,
            writer=ledger,
            observer=RunCallbacks(note=notes.append),
        )
    )
    if edits:  # those that a branch was made with
        EditObserver(edits, known=len(edits)).attach(session)
    engine = Engine(
        session,
        ledger,
        lines,
        supervisor=spec["supervisor"],
        checkpoints=spec["checkpoints"] > 0,
        idle=idle,
    )
    lines.send(
        {
            "notice": "ready",
            "events": history.limit,
            "is_trace": trace is not None,
            "notes": notes,
            "start_ns": session.start_ns,
        }
    )
    engine.run()


def _middleware_threads() -> frozenset[int]:
    """Return the threads that DDS starts when it is loaded; a simulation does not use them."""
    from rsltrace.adapters.rclpy.boundary.installation import check_no_simulation

    check_no_simulation()
    with suppress(ImportError):  # the session says what is missing
        import_module("rclpy")
    return other_threads()


if __name__ == "__main__":
    main()
