"""A simulation that can go on in several ways, each in a copy of its process."""

from __future__ import annotations

import os
import pickle
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NoReturn, TypeVar

from rsltrace.child_processes import how_ended
from rsltrace.errors import RunError
from rsltrace.forking import (
    Pairs,
    end_process,
    fork_below,
    open_descriptors,
    other_threads,
    own_children,
    why_not,
)
from rsltrace.job import FaultSpec, Job
from rsltrace.run.branching import why_no_branch, why_no_branches
from rsltrace.run.inputs import check_output
from rsltrace.run.session import RunResult, RunSession
from rsltrace.trace.writer import TraceWriter

# A function that runs in a copy of this process, and what comes back of it.


def in_copy(function: Callable[[int], Any], pairs: Pairs) -> Any:
    """Call ``function`` in a copy of this process, which ends with it; return what it returns,
    pickled on the way. It is given the descriptor of ours that the copy answers at; ``pairs`` as
    for ``fork_below``.

    :raises Exception: what it raises, as it is if that can be pickled.
    :raises RunError: there can be no copy, or it dies, or the value cannot be pickled.
    """
    for stream in filter(None, (sys.stdout, sys.stderr)):  # who has closed one has None there
        stream.flush()  # or both would write what waits there
    read_end, write_end = os.pipe()
    pid = fork_below(pairs)
    if pid == 0:
        os.close(read_end)
        _answer(function, write_end)
    os.close(write_end)
    status: int | None = None
    try:
        with open(read_end, "rb") as answers:
            data = answers.read()
    except BaseException:
        os.kill(pid, signal.SIGKILL)
        raise
    finally:
        with suppress(ChildProcessError):  # who ignores the ends of its children has no status
            status = os.waitpid(pid, 0)[1]
    if not data:
        how = "has died" if status is None else how_ended(os.waitstatus_to_exitcode(status))
        raise RunError(f"the copy of the simulation {how}")
    kind, value = pickle.loads(data)
    if kind == "raised":
        raise value
    return value


def _answer(function: Callable[[int], Any], write_end: int) -> NoReturn:
    """Call the function, write what comes of it to ``write_end``, and end this process."""
    status = 1
    try:
        try:
            answer = _pickled("returned", function(write_end))
        except BaseException as error:
            answer = _pickled("raised", error)
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        while answer:
            answer = answer[os.write(write_end, answer) :]
        status = 0
    finally:
        end_process(status)
    raise AssertionError("it has ended")


def _pickled(kind: str, value: Any) -> bytes:
    try:
        data = pickle.dumps((kind, value))
        pickle.loads(data)
        return data
    except Exception as error:
        if kind == "raised":
            other = RunError(f"{type(value).__qualname__}: {value}")
        else:
            other = RunError(f"what the function returns cannot leave the copy: {error}")
        return pickle.dumps(("raised", other))


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ForkResult(Generic[T]):
    """What a function returned that ran in a copy of a simulation, and how the copy's run went."""

    value: T
    result: RunResult


class ForkedRun:
    """The session of such a simulation. Its trace waits in memory for its place."""

    def __init__(self, job: Job, output: Path | None, *, force: bool, echo: bool) -> None:
        self._output = output
        self._force = force
        writer = TraceWriter(None, force=force, events_per_segment=job.record.segment_events)
        self.session = RunSession(job, None, force=force, echo=echo, writer=writer)
        self.session.may_become = True
        self._descriptors: list[int] = []
        self._threads: frozenset[int] = frozenset()
        self._children: list[int] = []

    def begin(self) -> None:
        """Take note of what there is before the run.

        :raises OutputError: its trace cannot be written.
        """
        if self._output is not None:
            check_output(self.session.job, self._output, None)
        self._descriptors = [number for number, _, _ in open_descriptors()]
        self._threads = other_threads()
        self._children = own_children()

    def settle(self) -> None:
        """Write the trace of a run that is over, if it is to have one."""
        if self._output is not None:
            self.session.settle(self._output)

    def job_with(self, faults: Sequence[FaultSpec | dict[str, Any]]) -> Job:
        """Return the job with more faults.

        :raises JobError: one makes no sense.
        :raises RunError: one is of what has been already, or no run can go on so.
        """
        old = self.session.job
        job = old.replace(faults=[*old.faults, *faults]) if faults else old
        why = why_no_branches(old) or why_no_branch(self.session, job)
        if why:
            raise RunError(f"this simulation cannot fork: {why}")
        return job

    def in_copy(self, function: Callable[[], Any]) -> Any:
        """Call a function in a copy of this process.

        :raises RunError: there can be none.
        """
        pairs = self.session.inner_pairs()
        why = why_not(self._descriptors, self._threads, pairs, self._children)
        if why:
            raise RunError(f"this simulation cannot fork: {why}")

        def within(write_end: int) -> Any:
            self._descriptors.append(write_end)
            self.session.changes_process(os.getpid(), pairs)
            return function()

        return in_copy(within, pairs)

    def begin_copy(self, job: Job, output: Path | None) -> None:
        """Be the run of the copy from here on.

        :raises OutputError: its trace cannot be written.
        """
        self._output = None
        self.session.becomes(job)
        if output is not None:
            self.session.settle(output)
