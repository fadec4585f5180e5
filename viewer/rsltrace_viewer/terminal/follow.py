"""Following a file that is still being recorded: looking again when it got longer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread
from time import perf_counter
from typing import Any, TypeVar

from textual.app import App
from textual.worker import get_current_worker

from rsltrace.errors import RsltraceError
from rsltrace.trace.mcap.records import MAGIC
from rsltrace_viewer.model.run import Run

# Long walks through a trace that never hold up the screen.
#
# A walk is an iterator. It gets a moment right away, which is enough for most; what takes longer
# goes on in a thread, and a newer walk of the same group ends it.

T = TypeVar("T")
_AT_ONCE_S = 0.02
_REPORT_S = 0.08


def walk(
    app: App[Any],
    group: str,
    steps: Iterator[T],
    arrive: Callable[[T | None, bool], None],
    *,
    at_once_s: float = _AT_ONCE_S,
) -> None:
    """Run ``steps`` to their end and call ``arrive(last, done)`` now and then, and when done.

    ``arrive`` runs on the app's thread. If there was no step at all it gets None.
    """
    app.workers.cancel_group(app, group)
    last: T | None = None
    started = perf_counter()
    while perf_counter() - started < at_once_s:
        try:
            last = next(steps)
        except StopIteration:
            arrive(last, True)
            return
    if last is not None:
        arrive(last, False)

    def rest() -> None:
        worker = get_current_worker()
        latest = last
        reported = perf_counter()
        try:
            for item in steps:
                if worker.is_cancelled:
                    return
                latest = item
                if perf_counter() - reported > _REPORT_S:
                    app.call_from_thread(_unless_cancelled, worker, arrive, latest, False)
                    reported = perf_counter()
            if not worker.is_cancelled:
                app.call_from_thread(_unless_cancelled, worker, arrive, latest, True)
        except RsltraceError as error:
            if not worker.is_cancelled:
                app.call_from_thread(app.notify, str(error), severity="error")

    app.run_worker(rest, group=group, thread=True, exclusive=True, exit_on_error=False)


def _unless_cancelled(worker: Any, arrive: Callable[..., None], item: object, done: bool) -> None:
    if not worker.is_cancelled:
        arrive(item, done)


# Telling a viewer of Rerun's what is selected: it is driven by a process of its own.

_END_S_MAX = 15.0
"""The viewer gets a moment to end; then whatever is left of it ends with the process."""


class RerunFollower:
    """Has Rerun's cursor follow; ``start`` begins, ``close`` ends all of it."""

    def __init__(self, traces: Sequence[Path]) -> None:
        self._traces = traces
        self._process: subprocess.Popen[bytes] | None = None
        self._closing = False

    def start(self, say: Callable[[str, bool], None]) -> None:
        """Begin. ``say`` is called in a thread, with what there is to know, and whether that is
        the end of it."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rsltrace_viewer.rerun_export.follow", *map(str, self._traces)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is not for it
        )
        assert self._process.stdin is not None
        os.set_blocking(self._process.stdin.fileno(), False)
        Thread(target=self._listen, args=(self._process, say), daemon=True).start()

    def select(self, event: int, stamp_ns: int, row: int | None = None) -> None:
        """Have the cursor go to an event, its row or its simulated time, without waiting for it."""
        if self._process is not None and self._process.stdin is not None:
            where = {"event" if row is None else "row": event if row is None else row}
            line = json.dumps({**where, "sim_time": stamp_ns}) + "\n"
            with suppress(OSError):  # it has ended, and has said so
                os.write(self._process.stdin.fileno(), line.encode())

    def close(self) -> None:
        self._closing = True
        if self._process is None:
            return
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(_END_S_MAX)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _listen(self, process: subprocess.Popen[bytes], say: Callable[[str, bool], None]) -> None:
        assert process.stdout is not None
        failed = ""
        with process.stdout, suppress(RuntimeError):  # the screen may be gone
            for line in process.stdout:
                found = json.loads(line)
                failed = found.get("failed", "")
                if not failed:
                    say(found["said"], False)
            if not self._closing:
                say(f"{failed or 'Rerun has ended'}; the selection is no longer followed", True)


_EVERY_S = 0.5
_IDLE_FACTOR = 5
"""Without its summary a trace is walked from the start; that may take a sixth of the time."""


class Follow:
    """Looks at the size of a file and opens it again, in a thread, when it has grown."""

    def __init__(self, app: App[Any], path: Path, grown: Callable[[Run], None]) -> None:
        self._app = app
        self._path = path
        self._grown = grown
        self._size = -1
        self._not_before = 0.0
        self._opening = False
        self._timer = app.set_interval(_EVERY_S, self._look)

    def stop(self) -> None:
        self._timer.stop()

    def _look(self) -> None:
        try:
            size = os.stat(self._path).st_size
        except OSError:
            return
        if self._opening or size == self._size:
            return
        if perf_counter() < self._not_before and not _is_finished(self._path):
            return
        self._size = size
        self._opening = True
        self._app.run_worker(self._open, group="follow", thread=True, exit_on_error=False)

    def _open(self) -> None:
        started = perf_counter()
        try:
            run = Run.open(self._path)
        except RsltraceError as error:
            self._app.call_from_thread(self._failed, str(error))
            return
        self._not_before = perf_counter() + _IDLE_FACTOR * (perf_counter() - started)
        self._app.call_from_thread(self._arrived, run)

    def _failed(self, message: str) -> None:
        self._opening = False
        self.stop()
        self._app.notify(message, severity="error")

    def _arrived(self, run: Run) -> None:
        self._opening = False
        if run.trace.complete:
            self.stop()
        self._grown(run)


def _is_finished(path: Path) -> bool:
    """Return whether a recording was closed: then it has a summary and opens at once."""
    with suppress(OSError), path.open("rb") as stream:
        stream.seek(-len(MAGIC), os.SEEK_END)
        return stream.read() == MAGIC
    return False
