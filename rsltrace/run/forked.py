"""A simulation that can go on in several ways, each in a copy of its process."""

from __future__ import annotations

import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NoReturn, TypeVar

from greenlet import getcurrent

from rsltrace.child_processes import how_ended
from rsltrace.errors import RunError
from rsltrace.fast_dataclass import dataclass
from rsltrace.forking import (
    Pairs,
    end_process,
    fork_below,
    open_descriptors,
    other_threads,
    own_children,
    why_not,
)
from rsltrace.job import Job
from rsltrace.run.driver import next_step_ns
from rsltrace.run.inputs import check_output
from rsltrace.run.session import RunResult, RunSession
from rsltrace.run.stop_rules import given_rules
from rsltrace.simulation.loop.policy import Departures
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.writer import TraceWriter

if TYPE_CHECKING:
    from rsltrace.job import FaultSpec

# Stop in the middle of a run, from where runs of other jobs continue. Their jobs differ only in
# what comes later (``RunSession.becomes``): each run is as if made from the beginning.
# ``rsltrace.search.explore.prefix`` makes the copies of a search.


def run_up_to(session: RunSession, time_ns: int) -> bool:
    """Run up to and including a simulated time; return whether anything follows."""
    loop, runners = session.loop, session.world.runtime.runners

    def gate(next_ns: int | None) -> bool:
        coming_ns = next_step_ns(loop, next_ns)
        if coming_ns is not None and coming_ns <= time_ns:
            return False
        loop.gate = None
        runners.waiting.append(getcurrent())
        assert runners.main is not None
        runners.main.switch()
        return False

    loop.gate = gate
    session.begin()
    if not session.ended:
        session.go_on()
    return not session.ended


def why_no_branches(job: Job) -> str:
    """Return why no other run can go on from one of a job, "" if others can."""
    for _, _, rule in given_rules(job):
        if rule.prevents_forks:
            return rule.prevents_forks
    if any(fault.of_node for fault in job.faults):
        return "the job itself has faults of nodes"
    return ""


def why_no_branch(session: RunSession, job: Job) -> str:
    """Return why a job's run cannot branch off where a session stands, or ""."""
    first = next(_obstacles(session, job), "")
    at = format_seconds(session.loop.now_ns - session.start_ns)
    return first and f"{first} up to {at} s"


def _obstacles(session: RunSession, job: Job) -> Iterator[str]:
    """Yield what already differs."""
    old, loop = session.job, session.loop
    before = getattr(loop, "policy", None)
    policy = job.policy
    if policy != old.policy and policy is not None:
        if policy.departures is not None:
            done = before.choices if isinstance(before, Departures) else 0
            if any(one.choice < done for one in policy.departures):
                yield "its order departs from the plain one"
        elif policy.after_ns is None or session.start_ns + policy.after_ns < loop.now_ns:
            yield "its policy chooses"
        elif policy.order == "rate_monotonic":
            yield "its policy follows chains"
    own = len(old.faults)
    if job.faults[:own] != old.faults:
        yield "it is without faults of the job"
    if not all(_is_to_come(fault, session) for fault in job.faults[own:]):
        yield "it has a fault"


def _is_to_come(fault: FaultSpec, session: RunSession) -> bool:
    if fault.of_node:  # of those that come at a time, the order among what is due then is another
        return fault.event is not None and fault.event >= session.loop.events
    assert fault.message is not None
    if fault.of_bag:
        bags = session.bag_faults
        return bags is None or fault.message > bags.reached[fault.name]
    reached = session.world.domain.transport.faults.get(fault.name)
    return reached is None or fault.message > reached.reached


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
