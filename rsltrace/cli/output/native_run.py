"""``rsltrace record --native``: run, report and exit."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsltrace.cli.output.search_progress import interruptible, progress
from rsltrace.errors import NodeError
from rsltrace.terminal import say, tell
from rsltrace.trace.model.texts import format_duration, format_seconds

if TYPE_CHECKING:
    from rsltrace.cli.output.checks import CheckReport
    from rsltrace.job import Job
    from rsltrace.native.native_run import NativeOptions, NativeResult
    from rsltrace.simulation.loop.stop import Stop


def run_native(
    job: Job,
    path: Path,
    options: NativeOptions,
    *,
    force: bool,
    echo: bool,
    shows: bool,
    note: Callable[[str], None],
    begins: Callable[[], None],
) -> NativeResult:
    """Run a job natively; ``shows``: with progress. ``begins`` is called first."""
    from rsltrace.adapters.rclpy.boundary.installation import native_extension

    native_extension()  # before the session's modules, which bind it
    from rsltrace.native.session import run_natively
    from rsltrace.run import RunCallbacks

    shown = progress(quiet=not shows, what="observing", time="of real time")
    with interruptible() as on_interrupt, shown as on_progress:

        def interrupt(stop: Callable[[Stop], None]) -> None:
            begins()
            on_interrupt(stop)

        observer = RunCallbacks(progress=on_progress, interrupt=interrupt, note=note)
        return run_natively(job, path, options, force=force, echo=echo, observer=observer)


def report_native(result: NativeResult, checked: CheckReport | None, *, as_json: bool) -> None:
    error = result.error
    for note in result.notes:
        tell(f"note: {note}")
    if error is not None:
        if isinstance(error, NodeError) and error.traceback_text:
            tell(error.traceback_text.rstrip())
        tell(f"rsltrace: error: {error}")
    for line in [] if checked is None else checked.lines():
        tell(line)
    if as_json:
        say(json.dumps(_values(result, checked)))
        return
    kept = result.kept and f" ({result.kept})"
    tell(f"wrote {result.path}{kept}: {result.stop_reason}")
    cost = f"observer {format_duration(result.observer_ns)} per callback"
    say(f"native  events {result.events}  real {format_seconds(result.duration_ns)}  {cost}")


def _values(result: NativeResult, checked: CheckReport | None) -> dict[str, Any]:
    return {
        "native": True,
        "path": str(result.path),
        "digest": None,
        "events": result.events,
        "duration_ns": result.duration_ns,
        "observer_ns": result.observer_ns,
        "pen_ns": result.pen_ns,
        "callback_ns": result.callback_ns,
        "stop_reason": result.stop_reason,
        "exit_code": result.exit_code,
        "error": None if result.error is None else str(result.error),
        "stuck": list(result.stuck),
        **({} if checked is None else checked.values()),
        "notes": [*result.notes, *([result.kept] if result.kept else [])],
    }


def leave(result: NativeResult, status: int) -> None:
    """End the process, even if the thread of a stuck callback would keep it alive."""
    if result.stuck:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError):
                stream.flush()
        os._exit(status)
    sys.exit(status)
