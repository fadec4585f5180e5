"""The composition root: a Job in, a trace and a result out."""

from __future__ import annotations

import random
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsltrace.errors import BagError, RunError
from rsltrace.job import Job, locate
from rsltrace.loop.loop import EventLoop
from rsltrace.loop.stop import Stop
from rsltrace.loop.timer_queue import timer_queue
from rsltrace.model.stamp import format_seconds
from rsltrace.run.bags import check_bag_types, open_bag_of, start_ns_of, start_players
from rsltrace.run.process import Observer, housekeeping, quiet_gc, search_path
from rsltrace.run.provenance import environment, payload_filter, sources, write_job
from rsltrace.run.stopping import end_ns_of, stop_conditions
from rsltrace.trace.format import METADATA_ENVIRONMENT, METADATA_SOURCES
from rsltrace.trace.recorder import Recorder
from rsltrace.trace.writer import TraceWriter

if TYPE_CHECKING:
    from rsltrace.bag import Bag
    from rsltrace.ros.world import Entry, World


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run went. Times are simulated nanoseconds.

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

    @property
    def sim_seconds(self) -> str:
        """Simulated duration in seconds, with nine decimals."""
        return format_seconds(self.end_ns - self.start_ns)


def record(
    job: Job, output: str | Path | None, *, force: bool = False, echo: bool = False
) -> RunResult:
    """Run a job and record it to ``output`` (None: run without recording).

    ``echo`` prints the nodes' log records on stderr.

    :raises RunError: what went wrong in the run; the trace is complete up to there.
    :raises JobError, SetupError, BagError, OutputError: the run could not start or be written.
    """
    result = run(job, output, force=force, echo=echo)
    if result.error is not None:
        raise result.error
    return result


def run(
    job: Job,
    output: str | Path | None,
    *,
    force: bool = False,
    echo: bool = False,
    observer: Observer | None = None,
) -> RunResult:
    """Do ``record``, but return a failed run's error in the result instead of raising it."""
    from rsltrace.ros.world import World

    observer = observer or Observer()
    with ExitStack() as stack:
        bags = [stack.enter_context(open_bag_of(job, bag)) for bag in job.bags]
        start_ns = start_ns_of(job, bags)
        stack.enter_context(search_path(job))
        loop = EventLoop(
            start_ns=start_ns if job.construct_time_ns is None else job.construct_time_ns,
            timers=timer_queue(job.timer_ties),
            livelock_limit=job.livelock_limit,
            between_steps=housekeeping(lambda: world.core, observer, end_ns_of(job, start_ns)),
        )
        world = stack.enter_context(World(loop, base_dir=job.base_dir, seed=job.seed, echo=echo))
        # Whatever can be known to be wrong is found before a file is made.
        loop.stop_conditions = tuple(stop_conditions(job, start_ns, world.core.outside_events))
        entries = _prepare(job)
        check_bag_types(job, bags)
        writer = None
        if output is not None:
            writer = stack.enter_context(TraceWriter(Path(output), force=force))
            world.core.recorder = Recorder(writer, keep_payload=payload_filter(job))
            write_job(writer, job)
            writer.add_metadata(METADATA_ENVIRONMENT, environment())
            writer.add_metadata(METADATA_SOURCES, sources(job))
        if observer.interrupt is not None:
            observer.interrupt(loop.stop)
        stack.enter_context(quiet_gc())
        stop = _run_world(world, job, entries, bags, start_ns)
        error = world.error
        exit_code = error.exit_code if error is not None else stop.exit_code
        if writer is not None:
            writer.close(
                result={
                    "start_time": str(start_ns),
                    "end_time": str(loop.now_ns),
                    "stop_reason": stop.reason,
                    "exit_code": str(exit_code),
                }
            )
        recorder = world.core.recorder
        world.core.recorder = None  # what finalizers say from now on comes too late
        return RunResult(
            path=None if output is None else Path(output),
            digest=recorder.digest if recorder is not None else "",
            events=loop.events,
            start_ns=start_ns,
            end_ns=loop.now_ns,
            stop_reason=stop.reason,
            exit_code=exit_code,
            error=error,
        )


def _run_world(
    world: World, job: Job, entries: list[Entry], bags: list[Bag], start_ns: int
) -> Stop:
    """Go through the stages: construct, jump to the start, run, destroy."""
    core = world.core
    loop = core.loop
    random.seed(job.seed)
    if job.stop.topic is not None:
        from rsltrace.ros.watch import watch_exit_code

        core.watch(job.stop.topic.name, watch_exit_code(core, job.stop.topic))
    try:
        for entry in entries:
            if not world.construct(entry):
                break
        if loop.stopped is None:
            start_players(world, job, bags)
        if loop.stopped is None:
            world.jump(start_ns)
            stop = world.run()
        else:
            stop = loop.stopped
    except (RunError, BagError) as error:
        # Raised by the loop itself (a livelock) or the bag player, not by a callback.
        core.error = error if isinstance(error, RunError) else RunError(str(error))
        stop = Stop(str(error).splitlines()[0], core.error.exit_code)
    world.destroy()
    return stop


def _prepare(job: Job) -> list[Entry]:
    """Import what the job names and let rcl parse the arguments, before anything is constructed."""
    from rsltrace.ros.world import Entry, load_target, ros_arguments

    entries = []
    for index, spec in enumerate(job.nodes):
        where = locate(job, ("nodes", index, "node"))
        make: Any = load_target(spec.node, where=where) if isinstance(spec.node, str) else spec.node
        arguments = ros_arguments(
            name=spec.name,
            namespace=spec.namespace,
            parameters=spec.parameters,
            parameter_files=[job.resolve(path) for path in spec.parameter_files],
            remappings=spec.remappings,
            where=where,
        )
        entries.append(Entry(spec.target, partial(make, **spec.arguments), arguments))
    return entries
