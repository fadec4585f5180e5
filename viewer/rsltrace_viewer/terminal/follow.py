"""Following a file that is still being recorded: looking again when it got longer."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import Any

from textual.app import App

from rsltrace.errors import RsltraceError
from rsltrace.trace.mcap.records import MAGIC
from rsltrace_viewer.model.run import Run

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
        """Stop looking."""
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
