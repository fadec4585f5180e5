"""Runs with a common prefix: a process runs the prefix once, and each run continues in a fork.

A worker has one such process for runs in other orders and one for those with faults. It pauses
after the prefix, between two time steps, and is forked for each run. A run that cannot be forked,
or that differs in the prefix, runs from the beginning, and the answer says why.
"""

from __future__ import annotations

import fcntl
import json
import os
import select
import socket
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsltrace.child_processes import kill_group
from rsltrace.errors import DebugError, RsltraceError
from rsltrace.forking import die_with_parent, end_process, fork_beside, open_descriptors, why_not
from rsltrace.line_protocol import Lines
from rsltrace.search.explore.trial import JobSource, Trial

if TYPE_CHECKING:
    from rsltrace.run.session import RunSession
    from rsltrace.search.explore.outcome import TrialOptions
    from rsltrace.search.explore.steps import TrialObserver


_HIGH = 900
"""Descriptors from here on are not those that nodes get first."""


def take_ends(tell: int, say: int) -> int:
    """Redirect stderr to ``say``; return a high duplicate of ``tell``. Both stay open."""
    os.dup2(say, 2)
    return fcntl.fcntl(tell, fcntl.F_DUPFD_CLOEXEC, _HIGH)


def lead_nowhere(number: int) -> None:
    """Let a descriptor be that of the null device."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, number)
    os.close(nowhere)


def answer_and_end(run: Callable[[], dict[str, Any]], tell: int) -> None:
    """Write the answer of a run, or its error, and end this process."""
    status = 1
    try:
        try:
            answer = run()
        except RsltraceError as error:
            answer = {"trouble": str(error)}
        except OSError as error:
            of = f": {error.filename}" if error.filename else ""
            answer = {"trouble": f"{error.strerror or error}{of}"}
        data = json.dumps(answer).encode() + b"\n"
        while data:
            data = data[os.write(tell, data) :]
        status = 0
    except BaseException:
        import traceback

        with suppress(BaseException):
            os.write(2, traceback.format_exc().encode())
    finally:
        end_process(status)


def source_of(task: dict[str, Any]) -> JobSource:
    job = task["job"]
    return JobSource(**{**job, "overrides": tuple((one, two) for one, two in job["overrides"])})


_IN_COMMON: dict[str, Mapping[str, Any]] = {
    "policy": {"policy": {"departures": []}},
    "faults": {},
}
"""By kind of trial, the overlay of its common prefix."""


class Prefixes:
    """The processes of one worker that are paused at the end of a prefix."""

    def __init__(self) -> None:
        self._all: dict[str, _Prefix] = {}

    def fork(self, task: dict[str, Any], tell: int, say: int) -> tuple[int | None, str]:
        """Begin a trial in a fork of its prefix process, which answers at ``tell``; return its id,
        or None and why there is none."""
        kinds = list(task["trial"]["overlay"])
        if len(kinds) != 1 or kinds[0] not in _IN_COMMON:
            return None, "its settings apply from the beginning" if kinds else ""
        prefix = self._all.get(kinds[0])
        if prefix is None:
            prefix = self._all[kinds[0]] = _Prefix(task, _IN_COMMON[kinds[0]])
        return prefix.fork(task, tell, say)


class _Prefix:
    """The worker's side of one such process."""

    def __init__(self, task: dict[str, Any], overlay: Mapping[str, Any]) -> None:
        ours, theirs = socket.socketpair()
        worker = os.getpid()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # the other threads are idle
            self._pid = os.fork()
        if self._pid == 0:
            os.setsid()
            die_with_parent(worker)
            ours.close()
            _serve_forks(task, overlay, Lines(theirs), worker)
        theirs.close()
        self._lines = Lines(ours)
        self._lines.move_high()
        timeout_s = task.get("timeout_s")
        self._end_s = None if timeout_s is None else time.monotonic() + timeout_s
        answer = self._receive()
        self._why = str(answer.get("why", ""))
        if self._why:
            self._end()

    def fork(self, task: dict[str, Any], tell: int, say: int) -> tuple[int | None, str]:
        if self._why:
            return None, self._why
        timeout_s = task.get("timeout_s")
        self._end_s = None if timeout_s is None else time.monotonic() + timeout_s
        with suppress(OSError):  # it has died: there is no answer
            self._lines.send(task, tell, say)
        answer = self._receive()
        if "gone" in answer:
            self._why = answer["why"]
            self._end()
        return answer.get("pid"), str(answer.get("why", ""))

    def _receive(self) -> dict[str, Any]:
        poll = select.poll()
        poll.register(self._lines.fileno(), select.POLLIN)
        try:
            while (message := self._lines.next()) is None and not self._lines.ended:
                left_ms = None
                if self._end_s is not None:
                    left_ms = max(self._end_s - time.monotonic(), 0) * 1000
                if not poll.poll(left_ms):
                    return {"gone": True, "why": "the common prefix takes too long"}
                self._lines.read()
        except DebugError as error:
            return {"gone": True, "why": str(error)}
        return message or {"gone": True, "why": "the process that ran the common prefix has died"}

    def _end(self) -> None:
        self._lines.close()
        kill_group(self._pid)
        with suppress(ChildProcessError):
            os.waitpid(self._pid, 0)


# -- in the process itself -------------------------------------------------------------------------


def _serve_forks(
    task: dict[str, Any], overlay: Mapping[str, Any], lines: Lines, worker: int
) -> None:
    """Run the prefix, then fork this process on request. Never returns."""
    from rsltrace.guard.guard import engage

    lines.move_high()
    lead_nowhere(2)
    kept = [number for number, _, _ in open_descriptors()]
    try:
        with ExitStack() as stack:
            try:
                paused = _PausedRun(task, overlay, stack)
            except Exception as error:  # a run from the beginning reports it in full
                lines.send({"why": f"the common prefix fails: {error}"})
                return
            why = paused.why or why_not(kept, frozenset(), paused.session.inner_pairs())
            if why:
                lines.send({"why": why})
                return
            lines.send({"ready": True})
            while True:
                with engage(None):
                    request = lines.receive()
                    if request is None:
                        return
                    if not paused.serve(request, lines, worker):
                        continue
                paused.make(request)
    finally:
        end_process(0)


class _PausedRun:
    """A run that is paused after its prefix."""

    def __init__(self, task: dict[str, Any], overlay: Mapping[str, Any], stack: ExitStack) -> None:
        from rsltrace.run.forked import run_up_to, why_no_branches
        from rsltrace.run.process import preserved_process, skip_final_collection
        from rsltrace.run.session import RunSession
        from rsltrace.search.explore.outcome import TrialOptions
        from rsltrace.search.explore.steps import TrialObserver
        from rsltrace.trace.writer import TraceWriter

        skip_final_collection()
        self._stack = stack
        self._source = source_of(task)
        wants = TrialOptions(**task["wants"])
        job = self._source.job(Trial(0, overlay))
        self.why = why_no_branches(job)
        writer = TraceWriter(None, force=True, events_per_segment=job.record.segment_events)
        stack.enter_context(preserved_process())
        self.session: RunSession = RunSession(job, None, force=True, writer=writer)
        self.session.may_become = True
        stack.enter_context(self.session)
        self._watch: TrialObserver = TrialObserver(
            self.session, steps=wants.steps, fork_ns=wants.fork_ns
        )
        if not self.why and not run_up_to(self.session, self.session.start_ns + wants.fork_ns):
            self.why = "the common prefix ends before that"
        self._answer_at = -1

    def serve(self, task: dict[str, Any], lines: Lines, worker: int) -> bool:
        """Answer a request with a fork of this process, if possible. True in the fork.

        Nothing else happens here: garbage is not collected and would be in every fork.
        """
        tell, say = task["with"]
        try:
            pairs = self.session.inner_pairs()
            pid = fork_beside(worker, pairs)
            if pid:
                lines.send({"pid": pid})
                return False
            os.setsid()
            lines.close()
            self._answer_at = take_ends(tell, say)
            self.session.changes_process(os.getpid(), pairs)
            return True
        except RsltraceError as error:
            lines.send({"why": str(error)})
            return False
        finally:
            os.close(tell)
            os.close(say)

    def make(self, task: dict[str, Any]) -> None:
        """Continue as the run of a trial, and end this process. Never returns."""
        from rsltrace.search.explore.outcome import TrialOptions

        answer_and_end(lambda: self._made(task, TrialOptions(**task["wants"])), self._answer_at)

    def _made(self, task: dict[str, Any], wants: TrialOptions) -> dict[str, Any]:
        from rsltrace.run.forked import why_no_branch
        from rsltrace.search.explore.outcome import result_of_run

        began = time.perf_counter()
        trial = Trial(**task["trial"])
        job = self._source.job(trial)
        why = why_no_branch(self.session, job)
        if why:
            return {"why": why}
        self.session.becomes(job)
        self.session.settle(Path(task["trace"]))
        self.session.go_on()
        ran = self.session.finish()
        self._stack.close()
        result = result_of_run(job, trial, ran, self._watch, wants, began)
        return {"result": replace(result, is_forked=True).as_values()}
