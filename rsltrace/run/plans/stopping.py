"""From a job's ``stop:`` to the conditions that the loop asks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

from rsltrace.job import Job, locate, showing_line
from rsltrace.job.values.sizes import format_size
from rsltrace.run.plans.target import load_target
from rsltrace.simulation.loop.stop import (
    Progress,
    Stop,
    StopCondition,
    stop_after_events,
    stop_at,
    stop_when,
    stop_when_quiet,
)
from rsltrace.trace.model.stamp import format_seconds

if TYPE_CHECKING:
    from rsltrace.adapters.rclpy.entry import Entry
    from rsltrace.adapters.rclpy.world import World

_Context = Callable[[], AbstractContextManager[None]]


def end_ns_of(job: Job, start_ns: int) -> int | None:
    """Return the latest simulated time the run can reach, or None if time does not end it."""
    ends = []
    if job.stop.duration_ns is not None:
        ends.append(start_ns + job.stop.duration_ns)
    if job.stop.timeout_ns is not None:
        ends.append(start_ns + job.stop.timeout_ns)
    if job.stop.time_ns is not None:
        ends.append(job.stop.time_ns)
    return min(ends, default=None)


def stop_with(world: World, entries: Sequence[Entry]) -> None:
    """Let the run end when an entry has ended that is required."""
    required = {entry.key for entry in entries if entry.required}
    loop = world.domain.loop

    def told(what: str, key: str) -> None:
        if what == "ended" and key in required and loop.stopped is None:
            loop.stop(Stop(f"{key} has ended, which the run requires"))

    if required:
        world.stacks.programs.listeners.append(told)


def stop_conditions(
    job: Job,
    start_ns: int,
    outside_events: _Context = nullcontext,
) -> Iterator[StopCondition]:
    """Yield the conditions of a job; its stop function runs within ``outside_events()``.

    :raises JobError: if the stop function cannot be imported.
    """
    stop = job.stop
    if stop.duration_ns is not None:
        reason = f"duration of {format_seconds(stop.duration_ns)} s"
        yield stop_at(start_ns + stop.duration_ns, reason)
    if stop.timeout_ns is not None:
        reason = f"timeout of {format_seconds(stop.timeout_ns)} s"
        yield stop_at(start_ns + stop.timeout_ns, reason, exit_code=1)
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
            with showing_line(job, ("stop", "function")):
                function = load_target(function, where=locate(job, ("stop", "function")))
        else:
            name = f"{function.__module__}:{function.__qualname__}"
        yield stop_when(_within(outside_events, function), name)


def stop_at_size(size: int, written: Callable[[], int]) -> StopCondition:
    """Stop once ``written()`` bytes are as many as ``size``."""

    def condition(progress: Progress) -> Stop | None:
        return Stop(f"a trace of {format_size(size)}") if written() >= size else None

    return condition


def _within(
    context: _Context, function: Callable[[Progress], object]
) -> Callable[[Progress], object]:
    def call(progress: Progress) -> object:
        with context():
            return function(progress)

    return call


def has_stop(job: Job) -> bool:
    """Return whether the job says itself when it ends; otherwise its bags do."""
    if job.stop.topic is not None or job.stop.size is not None:
        return True
    return any(True for _ in stop_conditions(job, 0))
