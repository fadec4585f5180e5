"""A job from its start to its end on rclpy's own executors: a Job in, a trace and a result out."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rsltrace.doors.rclpy.boundary.installation import boundary, check_free
from rsltrace.doors.rclpy.exit_code_topic import watch_exit_code
from rsltrace.errors import JobError, NodeError, RsltraceError, RunError, SetupError
from rsltrace.job import Job, locate
from rsltrace.loop.stop import Progress, Stop
from rsltrace.mcap.sink import unfinished
from rsltrace.middleware.events.failure import text_of, user_traceback
from rsltrace.model.event import EventKind
from rsltrace.native import support
from rsltrace.native.boundary import Boundary
from rsltrace.native.domain import domain
from rsltrace.native.entries import RunningEntry
from rsltrace.native.executors import Executors, failure_of
from rsltrace.native.ledger import Ledger
from rsltrace.native.nodes import Nodes
from rsltrace.native.pen import Clocks, Pen
from rsltrace.native.priorities import Priorities
from rsltrace.native.things import Things
from rsltrace.run.inputs import check_output
from rsltrace.run.launch_files import without_launch_files
from rsltrace.run.plans.entries import node_entries
from rsltrace.run.plans.stopping import end_ns_of, stop_conditions
from rsltrace.run.process import Observer, kept_process, search_path
from rsltrace.run.provenance import environment, payload_filter, write_job, write_sources
from rsltrace.trace.format import METADATA_ENVIRONMENT, METADATA_NATIVE
from rsltrace.trace.recorder import Recorder
from rsltrace.trace.writer import TraceWriter

EXECUTORS = {"single": "SingleThreadedExecutor", "multi": "MultiThreadedExecutor"}
_LOOK_EVERY_S = 0.01
_CONSTRUCTED_WITHIN_S = 5.0
"""How long others wait for a constructor, which may itself wait for one of them."""
_ENDS_WITHIN_S = 5.0


@dataclass(frozen=True, slots=True)
class NativeResult:
    """How a native run went. ``duration_ns`` is real time, from when the nodes began to spin.

    ``observer_ns`` is the median of what observing a callback took in its thread, ``pen_ns`` the
    processor time of writing it down beside it. ``stuck`` are entries with a callback that did not
    come back at the end.
    """

    path: Path
    events: int
    duration_ns: int
    stop_reason: str
    exit_code: int
    observer_ns: int
    pen_ns: int
    error: RunError | None = None
    stuck: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    kept: str = ""


def run_natively(
    job: Job,
    output: Path,
    *,
    force: bool = False,
    echo: bool = True,
    executor: str = "single",
    domain_id: int | None = None,
    policy: str | None = None,
    observer: Observer | None = None,
) -> NativeResult:
    """Run a job natively and record it. What goes wrong in the run is in the result's ``error``.

    ``echo`` lets nodes print their log records. ``executor`` is that of each entry, ``single`` or
    ``multi`` (threaded). Without a ``domain_id`` the nodes are alone in a free domain of this
    machine. ``policy`` gives callbacks and threads priorities: ``rate_monotonic``, or ``priority``,
    that of the job.

    :raises JobError, SetupError, OutputError: the run could not start or be written.
    """
    check_free()
    expanded = without_launch_files(job)
    support.check(expanded.job)
    rules = support.priority_rules(expanded.job, policy)
    run = _Run(expanded.job, observer or Observer(), EXECUTORS[executor], domain_id, policy)
    if policy is not None:
        run.priorities = Priorities(run.things, rules)
    run.notes += expanded.notes
    with kept_process(), ExitStack() as stack:
        stack.enter_context(search_path(run.job))
        run.open(stack, output, force=force, echo=echo)
        run.go_on()
        return run.finish()


@dataclass
class _Run:
    """One run. Only its own thread calls it, but for ``_ended`` and ``stop``."""

    job: Job
    observer: Observer
    executor: str
    domain_id: int | None
    policy: str | None = None
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.ledger = Ledger()
        self.things = Things(self.ledger.add)
        self.boundary = Boundary(self.ledger, self.things)
        self.nodes = Nodes(self.things)
        self.priorities: Priorities | None = None
        self.error: RunError | None = None
        self.ending: Stop | None = None
        self._stopped = threading.Event()
        self._start = threading.Event()
        self._lock = threading.Lock()
        self._running: list[RunningEntry] = []
        self._begun_ns = 0
        self._ended_ns = 0
        self._start_ns = self.job.start_ns or 0

    def open(self, stack: ExitStack, output: Path, *, force: bool, echo: bool) -> None:
        """Find what can be known to be wrong, then start rclpy and create the trace."""
        job, note = self.job, self.observer.note or (lambda text: None)
        self.entries = node_entries(job, told=note)
        self.conditions = tuple(stop_conditions(job, self._start_ns))
        if self.priorities is not None and self.priorities.refused:
            note(f"{self.priorities.refused}; executors go by priorities all the same")
        if without := support.ignored(job, self.policy):
            note(f"a native run is not steered; without effect in the job: {', '.join(without)}")
        self.domain = stack.enter_context(domain(self.domain_id))
        for place in (output, unfinished(output)):
            check_output(job, place, None)
        stack.enter_context(_rclpy(echo=echo))
        self.writer = stack.enter_context(
            TraceWriter(output, force=force, events_per_segment=job.record.segment_events)
        )
        if self.observer.interrupt is not None:
            self.observer.interrupt(self.stop)
        recorder = Recorder(self.writer, keep_payload=payload_filter(job))
        clocks = Clocks.now()
        self.clocks = clocks
        write_job(self.writer, job)
        self.writer.add_metadata(METADATA_ENVIRONMENT, environment(job))
        write_sources(self.writer, job)
        self.writer.add_metadata(METADATA_NATIVE, self._described())
        self.pen = Pen(self.ledger, recorder, clocks, job.base_dir)
        executors = Executors(self.ledger, self.things, self.boundary)
        stack.enter_context(self.boundary.watched(boundary().real))
        if self.priorities is not None:
            stack.enter_context(self.priorities.watched(boundary().real))
        stack.enter_context(self.nodes.watched())
        stack.enter_context(executors.watched())
        self._watch_topic()

    def _described(self) -> dict[str, str]:
        return {
            "mode": "native",
            "middleware": boundary().real.rclpy_get_rmw_implementation_identifier(),
            "executor": f"{self.executor} per entry of the job",
            "processes": "1",
            "domain": str(self.domain),
            "discovery": "this machine" if self.domain_id is None else "as the environment says",
            "wall_ns": str(self.clocks.wall_ns),
            "steady_ns": str(self.clocks.steady_ns),
            "ignored": ", ".join(support.ignored(self.job, self.policy)),
            **(
                {}
                if self.priorities is None
                else {"policy": self.policy or "", "priorities": self.priorities.description}
            ),
        }

    def _watch_topic(self) -> None:
        spec = self.job.stop.topic
        if spec is None:
            return
        stops = SimpleNamespace(stop_after_step=self.stop)
        where = locate(self.job, ("stop", "topic", "exit_code"))
        watch = watch_exit_code(stops, spec, where=where)  # type: ignore[arg-type]

        def told(data: bytes, type: Any) -> None:
            try:
                watch(SimpleNamespace(msg_type=type), data)
            except RsltraceError as error:
                self._fail(RunError(str(error)))

        self.boundary.on_message[spec.name] = told

    def go_on(self) -> None:
        """Construct the nodes, one entry after the other, then spin all until the run ends."""
        self.pen.start()
        for entry in self.entries:
            if self._stopped.is_set():
                break
            one = RunningEntry(
                entry, self.ledger, self.nodes, self._make_executor, self._start, self._ended
            )
            self._running.append(one)
            one.start()
            self._wait_for(one)
        self._begun_ns = time.monotonic_ns()
        self._start.set()
        while not self._stopped.wait(_LOOK_EVERY_S):
            if self.pen.error is not None:
                break
            self._look()
        self._ended_ns = time.monotonic_ns()

    def _wait_for(self, one: RunningEntry) -> None:
        deadline = time.monotonic() + _CONSTRUCTED_WITHIN_S
        while not one.constructed.wait(_LOOK_EVERY_S):
            if self._stopped.is_set() or time.monotonic() > deadline:
                return

    def _look(self) -> None:
        now_ns = time.monotonic_ns() - self._begun_ns + self._start_ns
        last_ns = max(self.ledger.activity_ns - self._begun_ns, 0) + self._start_ns
        events = self.ledger.count
        progress = Progress(now_ns, None, self._start_ns, events, last_ns)
        for condition in self.conditions:
            stop = condition(progress)
            if stop is not None:
                self.stop(stop)
                return
        size = self.job.stop.size
        if size is not None and self.writer.size >= size:
            self.stop(Stop(f"a trace of {size} bytes"))
        if self.observer.progress is not None:
            self.observer.progress(now_ns, end_ns_of(self.job, self._start_ns), events)

    def _make_executor(self) -> Any:
        if self.priorities is not None:
            from rsltrace.native.priority_executor import PriorityExecutor

            return PriorityExecutor(self.priorities)
        import rclpy.executors

        return getattr(rclpy.executors, self.executor)()

    def stop(self, stop: Stop) -> None:
        """End the run, from any thread; the first reason counts."""
        with self._lock:
            if self.ending is None:
                self.ending = stop
        self._stopped.set()

    def _fail(self, error: RunError, reason: str = "") -> None:
        with self._lock:
            if self.error is None and self.ending is None:
                self.error = error
        self.stop(Stop(reason or str(error).splitlines()[0], error.exit_code))

    def _ended(self, one: RunningEntry, error: BaseException | None) -> None:
        """Take note that an entry is over."""
        if error is None:
            if not one.stopping:
                self.stop(Stop(f"{one.entry.name} has ended: rclpy was shut down"))
            return
        if isinstance(error, JobError):
            self._fail(RunError(str(error)))
            return
        node = one.nodes[0].get_fully_qualified_name() if one.nodes else ""
        what = f"a callback of {one.entry.name}" if node else f"constructing {one.entry.name}"
        reason = f"{what} raised {type(error).__qualname__}"
        stamp_ns = self.clocks.stamp(time.monotonic_ns())
        self._fail(
            NodeError(
                f"{reason}: {text_of(error)}",
                node=node,
                entity=one.entry.name,
                stamp_ns=stamp_ns,
                traceback_text=user_traceback(error),
            ),
            reason,
        )

    def finish(self) -> NativeResult:
        """Stop the entries, destroy the nodes, close the trace, and say how it went.

        :raises OutputError: if the trace cannot be written.
        """
        for one in self._running:
            one.stop()
        deadline = time.monotonic() + _ENDS_WITHIN_S
        for one in self._running:
            one.join(max(deadline - time.monotonic(), 0.1))
        stuck = tuple(one.entry.name for one in self._running if one.is_alive())
        ended_after = self.ledger.count
        self._destroy()
        self.pen.finish()
        stop = self.ending or Stop("nothing is left")
        exit_code = self.error.exit_code if self.error is not None else stop.exit_code
        events = self.ledger.count
        observer_ns = self.pen.observer_ns
        pen_ns = self.pen.cpu_ns // max(events, 1)
        self.writer.close(
            result={
                "start_time": str(self.clocks.wall_ns),
                "end_time": str(self.clocks.stamp(time.monotonic_ns())),
                "stop_reason": stop.reason,
                "exit_code": str(exit_code),
                "ended_after": str(ended_after),
                "observer_ns": str(observer_ns),
                "pen_ns": str(pen_ns),
                "unknown_causes": str(self.pen.causes.unknown),
                **self._levels(),
            },
            replace=self._begun_ns > 0 or exit_code == 0,
        )
        return NativeResult(
            path=self.writer.place,
            events=events,
            duration_ns=self._ended_ns - self._begun_ns,
            stop_reason=stop.reason,
            exit_code=exit_code,
            observer_ns=observer_ns,
            pen_ns=pen_ns,
            error=self.error,
            stuck=stuck,
            notes=(*self.notes, *self._said(stuck)),
            kept=self.writer.kept,
        )

    def _levels(self) -> dict[str, str]:
        if self.priorities is None:
            return {}
        levels = sorted(self.priorities.levels.items(), key=lambda one: (-one[1], one[0]))
        return {"thread_priorities": ", ".join(f"{name} {level}" for name, level in levels)}

    def _said(self, stuck: tuple[str, ...]) -> Iterator[str]:
        for name in stuck:
            yield f"a callback of {name} did not return within {_ENDS_WITHIN_S:g} s of the end"
        if self.boundary.unreadable:
            yield f"{self.boundary.unreadable} messages could not be read as bytes: no hash of them"

    def _destroy(self) -> None:
        """Destroy the nodes in the order of their construction, each as one event."""
        for one in self._running:
            for node in one.nodes if not one.is_alive() and self.error is None else ():
                self.ledger.begin(int(EventKind.SHUTDOWN), self.things.find(node))
                failure = None
                try:
                    node.destroy_node()
                except Exception as error:
                    failure = failure_of(error)
                finally:
                    self.ledger.end(failure)


@contextmanager
def _rclpy(*, echo: bool) -> Iterator[None]:
    """Initialize rclpy, and shut it down afterwards.

    :raises SetupError: if the middleware cannot be started.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    quiet = [] if echo else ["--ros-args", "--disable-stdout-logs"]
    try:
        rclpy.init(args=quiet, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:
        raise SetupError(
            f"ROS's middleware cannot be started: {text_of(error)}; see RMW_IMPLEMENTATION, and "
            "whether the loopback network is up (ip link)"
        ) from error
    try:
        yield
    finally:
        rclpy.try_shutdown()
