"""One run of a job in stages: open, begin, go on, finish.

This is the one way to run a job: ``record`` goes through the stages at once, ``Simulation`` lets a
driver decide how far to go.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsltrace.adapters.processes.adapter import ProcessAdapter
from rsltrace.errors import BagError, DeadlockError, RunError
from rsltrace.fast_dataclass import dataclass
from rsltrace.job import Job
from rsltrace.run.inputs import check_output, expand_launch_files
from rsltrace.run.plans.bags import (
    BagInput,
    bag_notes,
    check_bag_types,
    open_bag_of,
    run_start_ns,
    start_players,
)
from rsltrace.run.plans.entries import add_job_location, hook_entries, missed_starts, node_entries
from rsltrace.run.plans.executables import MainProgram
from rsltrace.run.plans.faults import BagFaults, arm_node_faults, arm_topic_faults, missed_faults
from rsltrace.run.plans.guard import RunGuard, install_guard, node_packages
from rsltrace.run.plans.network import clock_notes, clock_rules, network_plan
from rsltrace.run.plans.processes import make_process_adapter
from rsltrace.run.plans.recorded_order import (
    NativeOrderObserver,
    follow_recording,
    remember_choices,
    write_choices,
)
from rsltrace.run.plans.scheduling import (
    continued_policy,
    is_ordered,
    policy_of_job,
    scheduling_plan,
    stop_with,
    switches_at_lines,
    unmet_departures,
)
from rsltrace.run.process import (
    RunCallbacks,
    frozen_gc,
    gc_disabled,
    housekeeping,
    keep_freed_memory,
    search_path,
)
from rsltrace.run.provenance import (
    LateLibraryScan,
    SourceHashes,
    environment,
    own_libraries,
    payload_filter,
    source_files,
    write_job,
)
from rsltrace.run.stop_rules import (
    StopInputs,
    StopRule,
    conditions_of,
    end_ns_of,
    stop_rules,
    watch_messages,
)
from rsltrace.run.unused_rules import (
    drop_notes,
    has_rules,
    queue_drops,
    unused_parameters,
    unused_ros_parameters,
    unused_rules,
)
from rsltrace.run.watchdog import Watchdog
from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.loop.ordered import OrderedLoop
from rsltrace.simulation.loop.recorded_order import NativeOrderLoop
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.loop.timer_queue import timer_queue
from rsltrace.simulation.middleware.events.event import NameRegistry
from rsltrace.simulation.middleware.interface import AllTopicFaults
from rsltrace.trace.format import METADATA_ENVIRONMENT, METADATA_STATES
from rsltrace.trace.mcap.sink import unfinished_path
from rsltrace.trace.model.finding import (
    EndlessWait,
    GuardCount,
    encode_drops,
    encode_suppressed,
    encode_unseen,
    encode_waits,
    unseen_notes,
)
from rsltrace.trace.model.texts import format_seconds, shortened
from rsltrace.trace.recorder import Recorder
from rsltrace.trace.writer import TraceWriter

if TYPE_CHECKING:
    from rsltrace.adapters.rclpy.entry import JobEntry
    from rsltrace.adapters.rclpy.faults import NodeFaults
    from rsltrace.adapters.rclpy.handles.node_state import StateSamples
    from rsltrace.adapters.rclpy.world import World
    from rsltrace.run.plans.recorded_order import RecordedOrderObserver
    from rsltrace.simulation.chance.channel import NetworkPlan

_FOLDER = re.compile(r"/\S*/(?=[^/\s]+:\d)")
_WAITS_MAX = 2000
"""Characters of who waits for what in a deadlock that a trace keeps."""


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run went. Times are simulated nanoseconds.

    ``path`` is where the trace is: beside the one that it should have replaced if no run came about
    (see ``record``).
    ``digest`` is 16 hex digits, empty for a run that recorded nothing. ``error`` is set when the
    run failed; the trace is complete up to and including the event that failed.
    """

    path: Path | None
    digest: str
    events: int
    start_ns: int
    end_ns: int
    stop_reason: str
    exit_code: int
    error: RunError | None = field(default=None, compare=False)
    notes: tuple[str, ...] = ()
    """What is worth saying of a run that went well: what of a launch file or a bag it was without,
    how mains ended."""
    guarded: tuple[GuardCount, ...] = ()
    """How often the guard met each call, and what was done about it."""
    kept: str = field(default="", compare=False)
    """What to say of a trace that should have been replaced and was not."""

    @property
    def sim_seconds(self) -> str:
        """Simulated duration in seconds, with nine decimals."""
        return format_seconds(self.end_ns - self.start_ns)


class RunSession:
    """A run under way. Use as a context manager: within it, rclpy is simulated.

    ``begin`` constructs the nodes and jumps to the start, ``go_on`` runs the loop until it ends (or
    its gate pauses it), ``finish`` destroys the nodes, closes the trace and gives the result.
    """

    world: World
    loop: EventLoop
    start_ns: int
    end_ns: int | None
    """The latest simulated time the job lets the run reach, if time ends it."""
    may_become = False
    """Whether the run of another job may go on from it (``becomes``). Set before it is entered."""
    whole_graph = False
    """Whether entries that would start later are constructed with the others, to be seen."""

    def __init__(
        self,
        job: Job,
        output: Path | None,
        *,
        force: bool = False,
        echo: bool = False,
        observer: RunCallbacks | None = None,
        replay: Path | None = None,
        writer: TraceWriter | None = None,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
    ) -> None:
        """``writer`` records the run without an ``output``, and stays open; its owner also watches
        for callbacks that hang. ``metadata`` is added to the trace."""
        self.job = job
        self._metadata = metadata or {}
        self._replay = replay
        self._recorded_by = writer
        self.stop: Stop | None = None
        self._stop_rules: list[StopRule] = []
        self._output = output
        self.has_begun = False
        """Whether the nodes are constructed, and time stands at the start or beyond."""
        self._force = force
        self._echo = echo
        self._observer = observer or RunCallbacks()
        self._stack = ExitStack()
        self._writer: TraceWriter | None = None
        self._bags: list[BagInput]
        self._notes: tuple[str, ...]
        self._guarded: RunGuard
        self._entries: list[JobEntry]
        self._plan: NetworkPlan | None
        self._recorded: RecordedOrderObserver | NativeOrderObserver | None
        self._late: LateLibraryScan
        self._sources: SourceHashes | None = None
        self._processes: ProcessAdapter
        self._numerics_known = True
        self._samples: StateSamples | None = None
        self._faults: NodeFaults | None = None
        self.bag_faults: BagFaults | None = None

    def inner_pairs(self) -> list[tuple[int, int]]:
        """Return the pipes and socket pairs of which nodes hold both ends."""
        guard = self._guarded.guard
        return [] if guard is None else guard.descriptors.inner_pairs()

    def changes_process(self, pid: int, pairs: Sequence[tuple[int, int]]) -> None:
        """Continue in a copy of the process, which has new ``pairs`` of descriptors."""
        self.world.runtime.runners.process = pid
        guard = self._guarded.guard
        if guard is not None:
            guard.continue_in(pid)
            for one, other in pairs:
                guard.descriptors.join(one, other)

    def __enter__(self) -> RunSession:
        """Open everything. Whatever can be known to be wrong is found before a file is made.

        :raises JobError, SetupError, BagError, OutputError: the run cannot start or be written.
        """
        with ExitStack() as stack:
            self._open(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def _open(self, stack: ExitStack) -> None:
        from rsltrace.adapters.rclpy.boundary.installation import check_no_simulation
        from rsltrace.adapters.rclpy.world import World  # keeps functions that the guard redirects

        check_no_simulation()
        expanded = expand_launch_files(self.job)
        self.job = expanded.job
        self._open_bags(stack, expanded.notes)
        stack.enter_context(search_path(self.job))
        self._guarded = install_guard(stack, self.job)
        stack.enter_context(frozen_gc())  # the guard has looked at what there is
        self._make_world(stack, World)
        self._guarded.begin(self.world, self._replay)
        if self._guarded.guard is not None:
            self._processes.note_answer = self._guarded.guard.note_process_answer
        with self._guarded.engaged():
            self._import_targets()
        check_bag_types(self.job, self._bags)
        self._watchdog = Watchdog(self.world.domain, self.world.runtime.runners.thread)
        if self._observer.interrupt is not None:  # from here on there is a file to be closed
            self._observer.interrupt(self._interrupt)
        if self._output is not None:
            self._open_trace(stack, self._output)
        elif self._recorded_by is not None:
            self._record_to(self._recorded_by)
        stack.enter_context(gc_disabled())
        keep_freed_memory()
        if self._recorded_by is None:
            stack.enter_context(self._watchdog.on_duty())

    def _open_bags(self, stack: ExitStack, notes: Sequence[str]) -> None:
        """Open the bags, which may set the start and the end of the run."""
        job = self.job
        self._bags = [
            stack.enter_context(open_bag_of(job, index)) for index in range(len(job.bags))
        ]
        self.start_ns = run_start_ns(job, self._bags)
        self.end_ns = end_ns_of(job, self.start_ns)
        self._notes = (*notes, *bag_notes(job, self._bags), *clock_notes(job, self.start_ns))
        if self._observer.note is not None:
            for note in self._notes:
                self._observer.note(note)

    def _make_world(self, stack: ExitStack, kind: type[World]) -> None:
        """Make the loop and the world of the job, without nodes."""
        job = self.job
        self.loop = loop = self._loop_class()(
            start_ns=self.start_ns if job.construct_time_ns is None else job.construct_time_ns,
            timers=timer_queue(job.timer_ties),
            livelock_limit=job.livelock_limit,
            between_steps=housekeeping(
                lambda: self.world.domain.dispatcher, self._observer, self.end_ns
            ),
        )
        loop.origin_ns = self.start_ns
        loop.min_step_ns = job.min_time_step_ns
        self.world = world = stack.enter_context(
            kind(loop, base_dir=job.base_dir, seed=job.seed, echo=self._echo)
        )
        self._processes = make_process_adapter(job, world)
        stack.callback(self._processes.close)
        self._plan = network_plan(job, self.start_ns)
        if self._plan is not None:
            world.use_network(self._plan)
        if self.may_become:
            world.domain.transport.faults = AllTopicFaults()
        arm_topic_faults(job.faults, world)
        if has_rules(job):
            world.domain.entities.census = census = NameRegistry()
            world.domain.dispatcher.add_observer(census)
        self._order_events(stack)
        world.use_clocks(clock_rules(job), self.start_ns)

    def _loop_class(self) -> type[EventLoop]:
        if self.job.policy is not None and self.job.policy.recorded is not None:
            return NativeOrderLoop
        return OrderedLoop if is_ordered(self.job) else EventLoop

    def _order_events(self, stack: ExitStack) -> None:
        """Set the scheduling policy, executors and execution times of the job."""
        loop = self.loop
        self._recorded = follow_recording(self.job, self.world.domain, stack)
        if isinstance(loop, OrderedLoop):
            recorded = None if self._recorded is None else self._recorded.policy
            with self._guarded.engaged():
                self.world.use_scheduling(loop, scheduling_plan(self.job, self.start_ns, recorded))
            if switches_at_lines(self.job):
                self.world.switch_at_lines(loop, node_packages(self.job.nodes))

    def _trace_size(self) -> int:
        writer = self._writer or self._recorded_by
        return 0 if writer is None else writer.size

    def _import_targets(self) -> None:
        """Import stop function, hooks and nodes, and let rcl parse arguments."""
        job, world = self.job, self.world
        self._stop_rules = stop_rules(
            StopInputs(
                job,
                self.start_ns,
                trace_size=self._trace_size,
                outside_events=world.domain.dispatcher.outside_events,
            )
        )
        self.loop.stop_conditions = conditions_of(self._stop_rules)
        with world.importing():
            self._entries = [
                *hook_entries(job, "before", job.hooks.before, lambda: job),
                *node_entries(job, note=self._observer.note or (lambda text: None)),
                *hook_entries(job, "after", job.hooks.after, world.all_nodes),
            ]

    def _open_trace(self, stack: ExitStack, path: Path) -> None:
        """Create the file, and write what is known before the run."""
        job = self.job
        for place in (path, unfinished_path(path)):
            check_output(job, place, self._replay)
        self._writer = writer = stack.enter_context(
            TraceWriter(path, force=self._force, events_per_segment=job.record.segment_events)
        )
        if writer.place != path and self._observer.note is not None:
            self._observer.note(
                f"{path} is replaced when this run is over; until then the trace is in "
                f"{writer.place}"
            )
        self._record_to(writer)

    def _record_to(self, writer: TraceWriter) -> None:
        job = self.job
        programs = (entry.make for entry in self._entries)
        self._late = LateLibraryScan(one.code for one in programs if isinstance(one, MainProgram))
        recorder = Recorder(writer, keep_payload=self._payload_filter())
        self.world.domain.dispatcher.record(recorder)
        if self._observer.samples_states:
            from rsltrace.adapters.rclpy.handles.node_state import StateSamples

            self._samples = StateSamples(self.world.domain.dispatcher)
            self.world.domain.dispatcher.add_observer(self._samples)
        write_job(writer, job)
        described = environment(job)
        self._numerics_known = "numerics" in described
        writer.add_metadata(METADATA_ENVIRONMENT, described)
        self._sources = SourceHashes(writer, source_files(job))
        for name, values in self._metadata.items():
            writer.add_metadata(name, values)
        self._guarded.trace_begins(recorder, self.loop.now_ns)
        remember_choices(self.loop)

    def _payload_filter(self) -> Callable[[str], bool]:
        return payload_filter(self.job)

    def _interrupt(self, stop: Stop) -> None:
        """End the run at a signal: after the current event, or within it if it does not return."""
        self.loop.stop(stop)
        self._watchdog.signal = stop.exit_code - 128
        if self._watchdog.has_warned:
            raise KeyboardInterrupt

    @property
    def ended(self) -> bool:
        return self.stop is not None or self.loop.stopped is not None

    @property
    def place(self) -> Path | None:
        """Where the trace is being written, or None."""
        return None if self._writer is None else self._writer.place

    @property
    def error(self) -> RunError | None:
        return self.world.error

    @property
    def digest(self) -> str:
        """The digest so far, "" if nothing is recorded."""
        recorder = self.world.domain.dispatcher.recorder
        return "" if recorder is None else recorder.digest

    def begin(self) -> None:
        """Construct the nodes and jump to the start. Failures are in ``error``."""
        watch_messages(self._stop_rules, self.world.domain.watch, self.loop.stop_after_step)
        with self._failures(), self._engaged():
            self.world.plan(self._entries, self.start_ns)
            if not self.whole_graph:
                self._faults = arm_node_faults(self.job, self.world, self.start_ns)
            stop_with(self.world, self._entries)
            self.world.runtime.programs.fed = bool(self._bags)
            later = [one for one in self._entries if one.start_after and not self.whole_graph]
            for entry in later:
                self.world.starts.add(entry)
            for entry in self._entries:
                if entry in later or (entry.is_component and self.whole_graph):
                    continue
                if not self.world.construct(entry):
                    add_job_location(self.job, entry, self.world.error)
                    break
            if not self.ended:
                self.bag_faults = start_players(
                    self.world, self.job, self._bags, is_open=self.may_become
                )
            if not self.ended:
                if isinstance(self._recorded, NativeOrderObserver):
                    self._recorded.begin(plays=not later)
                self.world.jump(self.start_ns)
                self.has_begun = not self.ended
                self.world.starts.begin(self.start_ns)
        self._add_sources()

    def _add_sources(self, *, late: bool = False) -> None:
        if self._sources is not None:
            self._sources.add_loaded(self.job, late=late)
            for process in self._processes.processes:
                self._sources.add(own_libraries(self.job, process.code_files))

    def go_on(self) -> None:
        """Run the loop until it ends or its gate pauses it. Failures are in ``error``."""
        with self._failures(), self._engaged():
            self.world.go_on()
        failed, self.world.starts.failed = self.world.starts.failed, None
        if failed is not None:
            add_job_location(self.job, failed, self.world.error)

    @contextmanager
    def _engaged(self) -> Iterator[None]:
        with self._watchdog.watching(), self._guarded.engaged():
            yield

    @contextmanager
    def _failures(self) -> Iterator[None]:
        try:
            yield
        except (RunError, BagError) as error:
            # Raised by the loop itself (a livelock) or the bag player, not by a callback.
            failed = error if isinstance(error, RunError) else RunError(str(error))
            self.world.domain.outcome.error = failed
            self.stop = Stop(str(error).splitlines()[0], failed.exit_code)

    def becomes(self, job: Job) -> None:
        """Continue as the run of another job that differs only in what is still to come: its
        policy, and additional faults. ``why_not`` of ``rsltrace.run.forked`` says if that is
        possible.

        :raises JobError: its policy cannot be made.
        """
        old = self.job
        self.job = job = expand_launch_files(job).job
        if isinstance(self.loop, OrderedLoop) and job.policy != old.policy:
            with self._guarded.engaged():
                self.loop.policy = continued_policy(
                    policy_of_job(job, self.start_ns), self.loop.policy
                )
        faults = job.faults[len(old.faults) :]
        arm_topic_faults(faults, self.world)
        if self.bag_faults is not None:
            self.bag_faults.add(job, len(old.faults))
        self._faults = arm_node_faults(job, self.world, self.start_ns)

    def settle(self, path: Path) -> None:
        """Write what the ``writer`` was given so far, and all that follows, to a trace file.

        :raises OutputError: the trace cannot be written.
        """
        writer = self._recorded_by
        assert writer is not None, "it has no trace of its own"
        check_output(self.job, path, None)
        write_job(writer, self.job)
        writer.settle(path, force=self._force)
        self._writer = self._stack.enter_context(writer)

    def unused(self, *, lasted: bool = False) -> tuple[str, ...]:
        """Return the parts of the job without effect so far; ``lasted``: the run is over."""
        from rsltrace.adapters.rclpy.handles.node import parameters_of

        domain = self.world.domain
        lasted_ns = self.loop.now_ns - self.start_ns if lasted else None
        parameters = {**self.world.parameters, **parameters_of(domain.graph)}
        rules: list[str] = []
        census = domain.entities.census
        if census is not None:
            rules += unused_rules(self.job, census, self._plan, lasted_ns)
            rules += unused_ros_parameters(self.job, census, parameters, lasted=lasted)
        parameter_notes = unused_parameters(self.job, parameters, lasted=lasted)
        if not lasted:
            return (*rules, *parameter_notes)
        starts = missed_starts(self.job, self.world.starts.missed())
        faults = missed_faults(self.job, self.world, self._faults, self.bag_faults)
        if isinstance(self.loop, OrderedLoop):
            rules += unmet_departures(self.job, self.loop.policy)
        return (*rules, *parameter_notes, *starts, *faults)

    def finish(self, *, cut_short: bool = False) -> RunResult:
        """Destroy the nodes, close the trace, and return the result. A run that was ``cut_short``
        gets no notes on unused parts of its job.

        :raises OutputError: the rest of the trace cannot be written.
        """
        loop, outcome = self.loop, self.world.domain.outcome
        stop = self.stop or loop.stopped
        assert stop is not None, "a run ends with a reason"
        unused = () if cut_short or self.world.error else self.unused(lasted=True)
        if self._recorded is not None and self.world.error is None:
            unused = (*self._recorded.notes(), *unused)
        with self._engaged():
            outcome.note_end(loop.events)
            self._processes.end()
            if self._samples is not None:
                self._samples.take_last()
            self.world.destroy()
        self._add_sources(late=True)
        error = self.world.error
        exit_code = stop.exit_code or self.world.exit_code or self._processes.exit_code
        if error:
            exit_code = error.exit_code
        if self._writer is not None:
            self._guarded.write(self._writer)
            write_choices(self._writer, loop)
            if self._samples is not None:
                self._writer.add_metadata(METADATA_STATES, self._samples.as_metadata())
            self._writer.close(
                result={
                    "start_time": str(self.start_ns),
                    "end_time": str(loop.now_ns),
                    "stop_reason": stop.reason,
                    "exit_code": str(exit_code),
                    "ended_after": str(outcome.ended_after),
                    **self._order_of_starts(),
                    **_waits(error, outcome.waits),
                    **encode_suppressed(outcome.suppressed),
                    **encode_drops(queue_drops(outcome.drops)),
                    **encode_unseen(outcome.unseen),
                    **self._late_numerics(),
                },
                replace=self.has_begun or exit_code == 0,
            )
        digest = self.digest
        # What finalizers say from now on comes too late.
        self.world.domain.dispatcher.record(None)
        return RunResult(
            path=None if self._writer is None else self._writer.place,
            digest=digest,
            events=loop.events,
            start_ns=self.start_ns,
            end_ns=loop.now_ns,
            stop_reason=stop.reason,
            exit_code=exit_code,
            error=error,
            notes=(
                *self._notes,
                *outcome.notes,
                *drop_notes(outcome.drops),
                *unseen_notes(outcome.unseen),
                *unused,
            ),
            guarded=self._guarded.counts,
            kept="" if self._writer is None else self._writer.kept,
        )

    def _order_of_starts(self) -> dict[str, str]:
        """Return the order of constructions, where it is not the job's."""
        in_order = all(one.start_after is None and one.respawn is None for one in self._entries)
        if in_order and not any(fault.restart for fault in self.job.faults):
            return {}
        places = [str(self._entries.index(entry)) for entry in self.world.constructed]
        if self._bags:
            at_once = sum(entry.start_after is None for entry in self._entries)
            places.insert(at_once, str(len(self._entries)))  # the player
        return {"entries": ",".join(places)}

    def _late_numerics(self) -> dict[str, str]:
        """Return the kernels of numerical libraries that the run imported itself."""
        late = "" if self._numerics_known else self._late.find()
        return {"numerics": late} if late else {}


def _waits(error: RunError | None, waits: list[EndlessWait]) -> dict[str, str]:
    """Return the texts of a deadlock and of calls that still waited at the end, for the trace."""
    found = {"error": _without_folders(str(error))} if isinstance(error, DeadlockError) else {}
    return found | encode_waits(replace(one, text=_without_folders(one.text)) for one in waits)


def _without_folders(text: str) -> str:
    """Return a text without the folders of this machine."""
    return shortened(_FOLDER.sub("", text), _WAITS_MAX)
