"""Processes that run trials, many each: a run costs a fork, not a start of Python.

``Workers`` has several at a time and gives back results as they come; ``Worker`` is one of them,
for whoever has a place for one (a task of a cluster).
"""

from __future__ import annotations

import os
import select
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsltrace.child_processes import start_connected
from rsltrace.errors import DebugError, ExploreError
from rsltrace.line_protocol import Lines
from rsltrace.search.explore.trial import CRASH, Failure, JobSource, Trial, TrialResult, result_of

if TYPE_CHECKING:
    from rsltrace.search.explore.outcome import TrialOptions

_MAIN = "rsltrace.search.explore.worker"
_TRIES_MAX = 2


class Worker:
    """One process that runs trials, one at a time. A context manager.

    Its process is started when there is something to do, and again if it has died; a trial under
    way then is tried once more.
    """

    def __init__(self, source: JobSource, *, pins: bool = True) -> None:
        """``pins``: as ``guard.pin`` of the job says."""
        self._source = source
        self._pins = pins
        self._process: subprocess.Popen[bytes] | None = None
        self._lines: Lines | None = None
        self._task: dict[str, Any] | None = None
        self._tries = 0

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_busy(self) -> bool:
        """Whether it runs a trial."""
        return self._task is not None

    def fileno(self) -> int:
        """Return the descriptor at which an answer arrives."""
        assert self._lines is not None, "it is busy"
        return self._lines.fileno()

    def begin(
        self, trial: Trial, trace: Path, wants: TrialOptions, timeout_s: float | None = None
    ) -> None:
        """Begin to run a trial, which ends with ``result``."""
        assert self._task is None, "one trial at a time"
        self._task = {
            "job": asdict(self._source),
            "trial": asdict(trial),
            "trace": str(trace),
            "wants": asdict(wants),
            "timeout_s": timeout_s,
        }
        self._tries = 0
        self._send()

    def result(self) -> TrialResult | None:
        """Read what has arrived: return the trial's result, None if it is not over.

        :raises ExploreError: the run could not be made.
        """
        assert self._lines is not None
        assert self._task is not None
        try:
            self._lines.read()
            answer = self._lines.next()
        except DebugError as error:
            raise ExploreError(f"a worker does not answer as it should: {error}") from None
        if answer is not None:
            task, self._task = self._task, None
            if "trouble" in answer:
                raise ExploreError(f"{_named(task['trial'])}: {answer['trouble']}")
            return result_of(answer["result"])
        return self._again() if self._lines.ended else None

    def run(
        self, trial: Trial, trace: Path, wants: TrialOptions, timeout_s: float | None = None
    ) -> TrialResult:
        """Run a trial to its end.

        :raises ExploreError: the run could not be made.
        """
        self.begin(trial, trace, wants, timeout_s)
        while True:
            found = self.result()
            if found is not None:
                return found

    def close(self) -> None:
        """End the process, with whatever runs in it."""
        process, self._process, self._task = self._process, None, None
        if self._lines is not None:
            self._lines.close()
            self._lines = None
        if process is not None:
            with suppress(ProcessLookupError):
                process.kill()
            process.wait()

    def _again(self) -> TrialResult | None:
        """The process has died: try once more, or say so."""
        task = self._task
        assert task is not None
        self.close()
        if self._tries < _TRIES_MAX:
            self._task = task
            self._send()
            return None
        failure = Failure(CRASH, "the worker that ran it has died twice", "crash of the worker")
        return TrialResult(Trial(**task["trial"]), failure=failure)

    def _send(self) -> None:
        self._tries += 1
        if self._lines is None:
            self._start()
        assert self._lines is not None
        with suppress(OSError):  # it has died meanwhile: ``result`` says so
            self._lines.send(self._task or {})

    def _start(self) -> None:
        words = ["--no-pin"] * (not self._pins)
        try:
            self._process, ours = start_connected(
                _MAIN, words, stdout=subprocess.DEVNULL, start_new_session=True
            )
        except OSError as error:
            raise ExploreError(f"no worker can be started: {error.strerror}") from None
        self._lines = Lines(ours)


class Workers:
    """Several workers. ``submit`` while ``idle``; ``results`` waits for the next ones."""

    def __init__(self, source: JobSource, count: int, *, pins: bool = True) -> None:
        self._workers = [Worker(source, pins=pins) for _ in range(count)]

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.close()

    @property
    def idle(self) -> int:
        """How many have nothing to do."""
        return sum(not worker.is_busy for worker in self._workers)

    @property
    def busy(self) -> int:
        """How many run a trial."""
        return len(self._workers) - self.idle

    def submit(
        self, trial: Trial, trace: Path, wants: TrialOptions, timeout_s: float | None = None
    ) -> None:
        """Have an idle worker run a trial."""
        next(one for one in self._workers if not one.is_busy).begin(trial, trace, wants, timeout_s)

    def results(self, wait_s: float | None = None) -> Iterator[TrialResult]:
        """Wait until something has come, ``wait_s`` at most; yield the results of what is over.

        :raises ExploreError: a run could not be made.
        """
        busy = {worker.fileno(): worker for worker in self._workers if worker.is_busy}
        if not busy:
            return
        poll = select.poll()
        for number in busy:
            poll.register(number, select.POLLIN)
        for number, _ in poll.poll(None if wait_s is None else wait_s * 1000):
            found = busy[number].result()
            if found is not None:
                yield found


def default_jobs() -> int:
    """Return how many workers make use of this machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _named(trial: Mapping[str, Any]) -> str:
    return f"trial {trial['number']}" + (f" ({trial['why']})" if trial.get("why") else "")
