"""A simulation that can go on in several ways, each in a copy of its process."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from rsltrace.errors import RunError
from rsltrace.forking import open_descriptors, other_threads, own_children, why_not
from rsltrace.job import FaultSpec, Job
from rsltrace.run.branching import why_never
from rsltrace.run.branching import why_not as why_no_branch
from rsltrace.run.copying import in_copy
from rsltrace.run.inputs import check_output
from rsltrace.run.session import RunResult, Session
from rsltrace.trace.writer import TraceWriter

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
        self.session = Session(job, None, force=force, echo=echo, writer=writer)
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
        why = why_never(old) or why_no_branch(self.session, job)
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

        def within(tell: int) -> Any:
            self._descriptors.append(tell)
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
