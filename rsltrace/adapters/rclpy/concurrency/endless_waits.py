"""Reports callbacks that waited until the end of the run, and those that never ran because of it.

A callback waits for ever if only a callback of its own mutually exclusive group could wake it. If
nothing else runs, that is reported as a deadlock; if other timers go on, it is reported here.
"""

from __future__ import annotations

from typing import Any

from rsltrace.adapters.rclpy.concurrency.coroutines import TaskRun
from rsltrace.adapters.rclpy.concurrency.runtime import BlockedCall, Runtime
from rsltrace.simulation.loop.ordered import OrderedLoop, SimulatedExecutor
from rsltrace.simulation.loop.policy import Candidate
from rsltrace.simulation.middleware.entity import DomainEntity
from rsltrace.simulation.middleware.events.event import RunOutcome
from rsltrace.trace.model.finding import EndlessWait
from rsltrace.trace.model.texts import format_duration, format_seconds

_LONG_NS = 1_000_000_000
"""Shorter waits are not reported: they may be over soon after the end."""

_NAMED_MAX = 4


def note_waits(runtime: Runtime, outcome: RunOutcome) -> None:
    """Note the calls that wait without a timeout at the end, and the callbacks they hold back."""
    starved = _starved(runtime)
    blocked = [
        one
        for one in runtime.runners.blocked
        if one.waiting and one.deadline_ns is None and one.held is None and not one.is_patient()
    ]
    noted = _note_busy_groups(runtime, outcome)
    for one in blocked:
        text, waited_ns = one.waits_for(), runtime.loop.now_ns - one.since_ns
        candidates = starved.get(_workers(runtime, one.event[0]), [])
        names = list(dict.fromkeys(candidate.item.describe() for candidate in candidates))
        parked = runtime.groups.parked.get(one.group, []) if one.group is not None else []
        held = [candidate.entity_id for candidate in candidates]
        held += [getattr(handle, "entity_id", 0) for handle, _, _ in parked]
        numbers = tuple(sorted({number for number in held if number}))
        outcome.waits.append(EndlessWait(one.since_ns, text, numbers))
        if waited_ns < _LONG_NS or one in noted:
            continue
        lasted = f"{format_duration(waited_ns)} until the end"
        if names:
            outcome.notes.append(
                f"held back for {lasted}, by a callback that keeps their executor busy: "
                f"{_some(names)}\n  {text}"
            )
        else:
            outcome.notes.append(f"waited for {lasted}: {text}")


def _starved(runtime: Runtime) -> dict[SimulatedExecutor | None, list[Candidate]]:
    """Return the ready callbacks without a worker, by simulated executor."""
    found: dict[SimulatedExecutor | None, list[Candidate]] = {}
    if isinstance(runtime.loop, OrderedLoop):
        for place in runtime.loop.starved():
            found.setdefault(place.workers, []).append(place.candidate)
    return found


def _workers(runtime: Runtime, handle: Any) -> SimulatedExecutor | None:
    """Return the simulated executor of a handle's callbacks, if any."""
    loop, is_entity = runtime.loop, isinstance(handle, DomainEntity)
    return loop.place(handle).workers if is_entity and isinstance(loop, OrderedLoop) else None


def _note_busy_groups(runtime: Runtime, outcome: RunOutcome) -> list[BlockedCall | TaskRun]:
    """Note the callbacks that wait for a group which has long been busy; return those that keep the
    groups busy."""
    holders = []
    for group, waiting in runtime.groups.parked.items():
        since_ns = min(since for _, since, _ in waiting)
        holder = _holder(runtime, group)
        if holder is None or runtime.loop.now_ns - since_ns < _LONG_NS:
            continue
        first: dict[str, int] = {}
        for handle, since, _ in waiting:
            name = handle.describe()
            first[name] = min(since, first.get(name, since))
        origin_ns = runtime.loop.origin_ns
        named = [f"{n} (since {format_seconds(at - origin_ns)} s)" for n, at in first.items()]
        holders.append(holder)
        outcome.notes.append(
            f"held back for {format_duration(runtime.loop.now_ns - since_ns)} until the end, by a "
            f"callback of the same mutually exclusive group: {_some(named)}\n  {holder.waits_for()}"
        )
    return holders


def _some(names: list[str]) -> str:
    more = len(names) - _NAMED_MAX
    return ", ".join(names[:_NAMED_MAX]) + (f" and {more} more" if more > 0 else "")


def _holder(runtime: Runtime, group: object) -> BlockedCall | TaskRun | None:
    """Return the callback that keeps a group busy, unless it waits with a timeout."""
    for blocked in runtime.runners.blocked:
        if blocked.group is group:
            return blocked if blocked.deadline_ns is None else None
    active = getattr(group, "_active_entity", None)
    number = getattr(getattr(active, "handle", None), "entity_id", None)
    return next(
        (run for run in runtime.coroutines.suspended if number and run.entity == number), None
    )
