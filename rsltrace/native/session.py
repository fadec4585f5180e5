"""A job from its start to its end on rclpy's own executors: a Job in, a trace and a result out."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rsltrace.adapters.rclpy.boundary.installation import check_no_simulation, native_extension
from rsltrace.errors import JobError, RunError, SetupError
from rsltrace.job import Job
from rsltrace.native import support
from rsltrace.native.callback_observer import EXECUTORS, CallbackObserver, make_executor
from rsltrace.native.message_observer import MessageObserver
from rsltrace.native.native_run import (
    ENDS_WITHIN_S,
    NativeOptions,
    NativeResult,
    NativeRun,
    rclpy_running,
)
from rsltrace.native.node_observer import NodeObserver
from rsltrace.native.observed_entities import ObservedEntities
from rsltrace.native.priorities import Priorities
from rsltrace.native.processes.run import MultiProcessRun
from rsltrace.native.running_entry import RunningEntry, destroy
from rsltrace.native.span_recorder import SpanRecorder
from rsltrace.native.support import Patience, domain
from rsltrace.run.inputs import expand_launch_files
from rsltrace.run.plans.entries import node_entries
from rsltrace.run.process import RunCallbacks, preserved_process, search_path
from rsltrace.run.watchdog import place_of
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.failure import exception_text, user_traceback

_CONSTRUCTED_WITHIN_S = 5.0
"""How long others wait for a constructor, which may itself wait for one of them."""


def run_natively(
    job: Job,
    output: Path,
    options: NativeOptions,
    *,
    force: bool,
    echo: bool,
    observer: RunCallbacks,
) -> NativeResult:
    """Run a job natively and record it. What goes wrong in the run is in the result's ``error``.
    ``echo`` lets nodes print their log records.

    :raises JobError, SetupError, OutputError: the run could not start or be written.
    """
    check_no_simulation()
    expanded = expand_launch_files(job, native=True)
    support.check(expanded.job)
    kind: type[SingleProcessRun | MultiProcessRun] = SingleProcessRun
    if options.processes or support.needs_processes(expanded.job):
        kind = MultiProcessRun
    rules = support.priority_rules(expanded.job, options.policy)
    run = kind(expanded.job, observer, options, rules)
    run.notes += expanded.notes
    with preserved_process(), ExitStack() as stack:
        stack.enter_context(search_path(run.job, native=True))
        run.open(stack, output, force=force, echo=echo)
        run.go_on()
        return run.finish()


class SingleProcessRun(NativeRun):
    """All entries in this process, a thread and an executor each."""

    def open(self, stack: ExitStack, output: Path, *, force: bool, echo: bool) -> None:
        """Find what can be known to be wrong, then start rclpy and create the trace."""
        self.recorder = SpanRecorder()
        self.entities = ObservedEntities(self.recorder.add)
        self.message_observer = MessageObserver(self.recorder, self.entities)
        self.nodes = NodeObserver(self.entities)
        self.priorities: Priorities | None = None
        if self.options.policy is not None:
            self.priorities = Priorities(self.entities, self.rules)
        self._cpu_ns = time.process_time_ns()
        self._start = threading.Event()
        self._running: list[RunningEntry] = []
        self.entries = node_entries(self.job, note=self.note)
        self.prepare(output)
        number = stack.enter_context(domain(self.options.domain_id))
        stack.enter_context(rclpy_running(echo=echo))
        described = {
            "middleware": native_extension().rclpy_get_rmw_implementation_identifier(),
            "executor": f"{EXECUTORS[self.options.executor]} per entry of the job",
            "processes": "1",
            "domain": str(number),
        }
        self.create(stack, output, self.recorder, described, force=force)
        executors = CallbackObserver(
            self.recorder, self.entities, self.message_observer, self.nodes.meet
        )
        stack.enter_context(self.message_observer.watched(native_extension()))
        if self.priorities is not None:
            stack.enter_context(self.priorities.watched(native_extension()))
        stack.enter_context(self.nodes.watched())
        stack.enter_context(executors.watched())
        self.watch_stop_topics(self.message_observer.on_message)

    def go_on(self) -> None:
        """Construct the nodes, one entry after the other, then spin all until the run ends."""
        self.span_writer.start()
        for entry in self.entries:
            if self.ending is not None:
                break
            one = RunningEntry(
                entry, self.recorder, self.nodes, self._make_executor, self._start, self._ended
            )
            self._running.append(one)
            one.start()
            self._wait_for(one)
        self.begun_ns, self._cpu_ns = time.monotonic_ns(), time.process_time_ns()
        self._start.set()
        for _ in self.wait():
            self.look(self.recorder.count, self.recorder.activity_ns)

    def _wait_for(self, one: RunningEntry) -> None:
        constructed = one.constructed
        Patience(_CONSTRUCTED_WITHIN_S).wait(
            constructed.wait, lambda: constructed.is_set() or self.ending is not None
        )

    def _make_executor(self) -> Any:
        return make_executor(EXECUTORS[self.options.executor], self.priorities)

    def _ended(self, one: RunningEntry, error: BaseException | None) -> None:
        """Take note that an entry is over."""
        if error is None:
            if not one.stopping:
                self.stop(Stop(f"{one.entry.name} has ended: rclpy was shut down"))
            return
        if isinstance(error, SetupError):  # interfaces that are not built
            self.fail(RunError(f"{one.failed_in}: {error}"))
            return
        if isinstance(error, JobError):
            self.fail(RunError(str(error)))
            return
        kind, said = type(error).__qualname__, exception_text(error)
        traceback = user_traceback(error)
        self.raised(one.failed_in, one.entry.name, one.node_name, kind, said, traceback)

    def finish(self) -> NativeResult:
        """Stop the entries, destroy the nodes, close the trace, and say how it went.

        :raises OutputError: if the trace cannot be written.
        """
        for one in self._running:
            one.stop()
        patience = Patience(ENDS_WITHIN_S)
        for one in self._running:
            patience.wait_for_end(one)
            patience.wait(time.sleep, one.is_idle)
        stuck = {one.entry.name: place_of(one.busy) for one in self._running if one.busy}
        ended_after = self.recorder.count
        for one in self._running:
            if not one.busy and self.error is None:
                destroy(one.nodes, self.recorder, self.entities)
        if self.priorities is not None:
            self.levels.update(self.priorities.levels)
        cpu_ns = time.process_time_ns() - self._cpu_ns - self.span_writer.cpu_ns
        unreadable = self.message_observer.unreadable
        return self.close(ended_after, stuck, unreadable, callbacks_ns=cpu_ns)
