"""Callbacks that waited until the end, and those that never ran because of it.

A callback that waits for something only a callback of its own mutually exclusive group can bring
waits for ever. Where nothing else runs either, that is a deadlock, and reported as one; where other
timers go on, the run ends as it should, and half of a node was dead all the time.
"""

from __future__ import annotations

from typing import Any

from rsltrace.adapters.rclpy.stacks.coroutines import TaskRun
from rsltrace.adapters.rclpy.stacks.runtime import BlockedCall, Runtime
from rsltrace.simulation.loop.ordered import OrderedLoop, Workers
from rsltrace.simulation.loop.policy import Candidate
from rsltrace.simulation.middleware.entity import DomainEntity
from rsltrace.simulation.middleware.events.event import Outcome
from rsltrace.trace.model.finding import EndlessWait
from rsltrace.trace.model.texts import format_duration, format_seconds

_LONG_NS = 1_000_000_000
"""A shorter wait may well be over soon after the end, and is not told."""

_NAMED_MAX = 4


def note_waits(stacks: Runtime, outcome: Outcome) -> None:
    """Say who still waits, at the end of a run, in a call that no passing of time ends, and what
    that keeps from running."""
    starved = _starved(stacks)
    blocked = [
        one
        for one in stacks.runners.blocked
        if one.waiting and one.deadline_ns is None and one.held is None and not one.is_patient()
    ]
    told = _held_in_groups(stacks, outcome)
    for one in blocked:
        text, waited_ns = one.waits_for(), stacks.loop.now_ns - one.since_ns
        candidates = starved.get(_workers(stacks, one.event[0]), [])
        names = list(dict.fromkeys(candidate.item.describe() for candidate in candidates))
        parked = stacks.groups.parked.get(one.group, []) if one.group is not None else []
        held = [candidate.entity_id for candidate in candidates]
        held += [getattr(handle, "entity_id", 0) for handle, _, _ in parked]
        numbers = tuple(sorted({number for number in held if number}))
        outcome.waits.append(EndlessWait(one.since_ns, text, numbers))
        if waited_ns < _LONG_NS or one in told:
            continue
        lasted = f"{format_duration(waited_ns)} until the end"
        if names:
            outcome.notes.append(
                f"held back for {lasted}, by a callback that keeps their executor busy: "
                f"{_some(names)}\n  {text}"
            )
        else:
            outcome.notes.append(f"waited for {lasted}: {text}")


def _starved(stacks: Runtime) -> dict[Workers | None, list[Candidate]]:
    """Return what is ready and has no worker, by simulated executor."""
    found: dict[Workers | None, list[Candidate]] = {}
    if isinstance(stacks.loop, OrderedLoop):
        for place in stacks.loop.starved():
            found.setdefault(place.workers, []).append(place.candidate)
    return found


def _workers(stacks: Runtime, handle: Any) -> Workers | None:
    """Return the simulated executor that the callbacks of a handle run on, None if on none."""
    loop, is_entity = stacks.loop, isinstance(handle, DomainEntity)
    return loop.place(handle).workers if is_entity and isinstance(loop, OrderedLoop) else None


def _held_in_groups(stacks: Runtime, outcome: Outcome) -> list[BlockedCall | TaskRun]:
    """Say of every callback group that has been busy for long who waits for it, and why; return
    who keeps them busy."""
    holders = []
    for group, waiting in stacks.groups.parked.items():
        since_ns = min(since for _, since, _ in waiting)
        holder = _holder(stacks, group)
        if holder is None or stacks.loop.now_ns - since_ns < _LONG_NS:
            continue
        first: dict[str, int] = {}
        for handle, since, _ in waiting:
            name = handle.describe()
            first[name] = min(since, first.get(name, since))
        named = [f"{name} (since {format_seconds(at)} s)" for name, at in first.items()]
        holders.append(holder)
        outcome.notes.append(
            f"held back for {format_duration(stacks.loop.now_ns - since_ns)} until the end, by a "
            f"callback of the same mutually exclusive group: {_some(named)}\n  {holder.waits_for()}"
        )
    return holders


def _some(names: list[str]) -> str:
    more = len(names) - _NAMED_MAX
    return ", ".join(names[:_NAMED_MAX]) + (f" and {more} more" if more > 0 else "")


def _holder(stacks: Runtime, group: object) -> BlockedCall | TaskRun | None:
    """Return the callback that keeps a group busy, unless it only waits for time to pass."""
    for blocked in stacks.runners.blocked:
        if blocked.group is group:
            return blocked if blocked.deadline_ns is None else None
    active = getattr(group, "_active_entity", None)
    number = getattr(getattr(active, "handle", None), "entity_id", None)
    return next(
        (run for run in stacks.coroutines.suspended if number and run.entity == number), None
    )
