"""The composition root: a Job in, a trace and a result out."""

from __future__ import annotations

import gc
import heapq
import importlib.metadata
import json
import platform
import random
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsltrace._version import __version__
from rsltrace.errors import BagError, JobError, RsltraceError, RunError
from rsltrace.job import BagSpec, Job, locate
from rsltrace.loop.loop import EventLoop
from rsltrace.loop.stop import (
    Stop,
    StopCondition,
    stop_after_events,
    stop_at,
    stop_when,
    stop_when_quiet,
)
from rsltrace.loop.timer_queue import timer_queue
from rsltrace.model.stamp import format_seconds
from rsltrace.trace.format import (
    ATTACHMENT_JOB,
    METADATA_ENVIRONMENT,
    METADATA_JOB,
    PREFIX_REQUEST,
    PREFIX_RESPONSE,
)
from rsltrace.trace.recorder import Recorder
from rsltrace.trace.writer import TraceWriter

if TYPE_CHECKING:
    from rsltrace.bag import Bag
    from rsltrace.ros.world import Entry, World

_GC_EVERY_EVENTS = 10_000
_PACKAGES = ("rclpy", "numpy", "scipy", "rosbags", "mcap", "xxhash")


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


@dataclass(frozen=True, slots=True)
class Observer:
    """Hooks for whoever watches a run. ``progress`` gets (simulated ns, end ns or None, events)
    about every thousand time steps; ``interrupt`` gets a function that ends the run properly."""

    progress: Callable[[int, int | None, int], None] | None = None
    interrupt: Callable[[Callable[[Stop], None]], None] | None = None


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
        bags = [stack.enter_context(_open_bag(job, bag)) for bag in job.bags]
        start_ns = _start_ns(job, bags)
        stack.enter_context(_search_path(job))
        loop = EventLoop(
            start_ns=start_ns if job.construct_time_ns is None else job.construct_time_ns,
            timers=timer_queue(job.timer_ties),
            livelock_limit=job.livelock_limit,
            between_steps=_housekeeping(lambda: loop, observer, _end_ns(job, start_ns)),
        )
        world = stack.enter_context(World(loop, base_dir=job.base_dir, echo=echo))
        # Whatever can be known to be wrong is found before a file is made.
        loop.stop_conditions = tuple(_stop_conditions(job, start_ns))
        entries = _prepare(job)
        _check_bag_types(job, bags)
        writer = None
        if output is not None:
            writer = stack.enter_context(TraceWriter(Path(output), force=force))
            world.core.recorder = Recorder(writer, keep_payload=_payload_filter(job))
            _write_job(writer, job)
            writer.add_metadata(METADATA_ENVIRONMENT, environment())
        if observer.interrupt is not None:
            observer.interrupt(loop.stop)
        stack.enter_context(_quiet_gc())
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
            _start_players(world, job, bags)
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


# -- bags ----------------------------------------------------------------------------------------


def _open_bag(job: Job, spec: BagSpec) -> Any:
    from rsltrace.bag import open_bag

    return open_bag(
        job.resolve(spec.path),
        topics=spec.topics,
        exclude=spec.exclude,
        start_offset_ns=spec.start_offset_ns,
    )


def _start_ns(job: Job, bags: list[Bag]) -> int:
    if job.start_ns is not None:
        return job.start_ns
    return min((bag.start_ns for bag in bags), default=0)


def _check_bag_types(job: Job, bags: list[Bag]) -> None:
    from rsltrace.ros.player import check_type

    for spec, bag in zip(job.bags, bags, strict=True):
        for topic in bag.topics:
            check_type(bag=spec.path, topic=topic.name, type_name=topic.type_name)


def _start_players(world: World, job: Job, bags: list[Bag]) -> None:
    """Make a publisher for every recorded topic and merge the bags by time, then by order."""
    if not bags:
        return
    from rclpy.node import Node

    from rsltrace.model.event import EventKind
    from rsltrace.ros.player import Player, make_publisher

    core = world.core
    streams: list[Iterator[tuple[int, Any, bytes]]] = []

    def build() -> None:
        player = Node("rosbag2_player", start_parameter_services=False, enable_rosout=False)
        publishers: dict[str, Any] = {}
        for spec, bag in zip(job.bags, bags, strict=True):
            for topic in bag.topics:
                if topic.name not in publishers:
                    publishers[topic.name] = make_publisher(
                        core,
                        player.handle,
                        bag=spec.path,
                        topic=topic.name,
                        type_name=topic.type_name,
                        qos=_qos_values(topic.qos),
                    )
            ends = [publishers[topic.name] for topic in bag.topics]
            streams.append(_messages(bag, ends))
        world.keep(player)

    core.run_outside(lambda: "the bag player", EventKind.CONSTRUCT, 0, None, build)
    if core.loop.stopped is not None:
        return
    ends_run = not list(_stop_conditions(job, 0)) and job.stop.topic is None

    def on_end() -> None:
        if ends_run:
            core.loop.stop_after_step(Stop("end of the bag"))

    Player(core, heapq.merge(*streams, key=lambda message: message[0]), on_end).start()


def _messages(bag: Bag, publishers: list[Any]) -> Iterator[tuple[int, Any, bytes]]:
    for stamp_ns, topic, data in bag.messages():
        yield stamp_ns, publishers[topic], data


def _qos_values(qos: Any) -> dict[str, Any]:
    if qos is None:
        return {}
    return {
        name: getattr(value, "name", value)
        for name in ("reliability", "durability", "history", "depth")
        if (value := getattr(qos, name, None)) is not None
    }


# -- stopping ------------------------------------------------------------------------------------


def _end_ns(job: Job, start_ns: int) -> int | None:
    ends = []
    if job.stop.duration_ns is not None:
        ends.append(start_ns + job.stop.duration_ns)
    if job.stop.time_ns is not None:
        ends.append(job.stop.time_ns)
    return min(ends, default=None)


def _stop_conditions(job: Job, start_ns: int) -> Iterator[StopCondition]:
    stop = job.stop
    if stop.duration_ns is not None:
        reason = f"duration of {format_seconds(stop.duration_ns)} s"
        yield stop_at(start_ns + stop.duration_ns, reason)
    if stop.time_ns is not None:
        yield stop_at(stop.time_ns, f"time {format_seconds(stop.time_ns)} s")
    if stop.events is not None:
        yield stop_after_events(stop.events)
    if stop.quiescence_ns is not None:
        yield stop_when_quiet(
            stop.quiescence_ns, f"quiet for {format_seconds(stop.quiescence_ns)} s"
        )
    if stop.function is not None:
        function: Any = stop.function
        name = str(function)
        if isinstance(function, str):
            from rsltrace.ros.world import load_target

            function = load_target(function, where=locate(job, ("stop", "function")))
        else:
            name = f"{function.__module__}:{function.__qualname__}"
        yield stop_when(function, name)


# -- the trace's own words -----------------------------------------------------------------------


def _payload_filter(job: Job) -> Callable[[str], bool]:
    spec = job.record

    def keep(topic: str) -> bool:
        name = topic
        for prefix in (PREFIX_REQUEST, PREFIX_RESPONSE):
            name = name.removeprefix(prefix)
        return (
            spec.payloads
            and any(fnmatchcase(name, glob) for glob in spec.topics)
            and not any(fnmatchcase(name, glob) for glob in spec.exclude)
        )

    return keep


def _write_job(writer: TraceWriter, job: Job) -> None:
    resolved = json.dumps(job.resolved(), sort_keys=True, ensure_ascii=False)
    name = Path(job.source_name).name
    writer.add_metadata(METADATA_JOB, {"name": name, "resolved": resolved})
    writer.add_attachment(ATTACHMENT_JOB, "application/yaml", job.source_text.encode())


def environment() -> dict[str, str]:
    """Return what a run's result may depend on: versions, never dates, names or paths."""
    values = {
        "rsltrace": __version__,
        "python": platform.python_version(),
        "implementation": platform.python_implementation(),
        "machine": platform.machine(),
        "system": platform.system(),
    }
    for package in _PACKAGES:
        try:
            values[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return values


# -- the process ---------------------------------------------------------------------------------


def _housekeeping(
    loop: Callable[[], EventLoop], observer: Observer, end_ns: int | None
) -> Callable[[], None]:
    """Return what is done between time steps: progress, and collecting garbage.

    Python's collector would otherwise run finalizers in the middle of some callback; here they run
    between steps, after the same events in every run.
    """
    collect_at = _GC_EVERY_EVENTS
    steps = 0

    def between_steps() -> None:
        nonlocal collect_at, steps
        steps += 1
        events = loop().events
        if events >= collect_at:
            collect_at = events + _GC_EVERY_EVENTS
            gc.collect(1)
        if steps % 1000 == 0 and observer.progress is not None:
            observer.progress(loop().now_ns, end_ns, events)

    return between_steps


@contextmanager
def _quiet_gc() -> Iterator[None]:
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextmanager
def _search_path(job: Job) -> Iterator[None]:
    """Let user modules be imported from the job's search path, and forget them afterwards."""
    folders = [str(job.resolve(folder)) for folder in job.search_path]
    old_path, old_modules = list(sys.path), set(sys.modules)
    sys.path[:0] = folders
    try:
        yield
    finally:
        sys.path[:] = old_path
        for name in set(sys.modules) - old_modules:
            file = getattr(sys.modules[name], "__file__", None)
            if file and any(Path(file).is_relative_to(folder) for folder in folders):
                del sys.modules[name]


__all__ = ["JobError", "Observer", "RsltraceError", "RunResult", "environment", "record", "run"]
