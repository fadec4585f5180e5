"""Callbacks that never ran because another one kept their callback group busy until the end.

A callback that waits for something only a callback of its own mutually exclusive group can bring
waits for ever. Where nothing else runs either, that is a deadlock, and reported as one; where other
timers go on, the run ends as it should, and half of a node was dead all the time.
"""

from __future__ import annotations

from rsltrace.doors.rclpy.stacks.coroutines import TaskRun
from rsltrace.doors.rclpy.stacks.runners import Wait
from rsltrace.doors.rclpy.stacks.stacks import Stacks
from rsltrace.model.stamp import format_duration, format_seconds

_LONG_NS = 1_000_000_000
"""A shorter wait may well be over soon after the end, and is not told."""

_NAMED_MAX = 4


def held_back(stacks: Stacks) -> list[str]:
    """Say of every callback group that has been busy for long who waits for it, and why."""
    notes = []
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
        more = len(named) - _NAMED_MAX
        who = ", ".join(named[:_NAMED_MAX]) + (f" and {more} more" if more > 0 else "")
        notes.append(
            f"held back for {format_duration(stacks.loop.now_ns - since_ns)} until the end, by a "
            f"callback of the same mutually exclusive group: {who}\n  {holder.waits_for()}"
        )
    return notes


def _holder(stacks: Stacks, group: object) -> Wait | TaskRun | None:
    """Return the callback that keeps a group busy, unless it only waits for time to pass."""
    for blocked in stacks.runners.blocked:
        if blocked.group is group:
            return blocked if blocked.deadline_ns is None else None
    active = getattr(group, "_active_entity", None)
    number = getattr(getattr(active, "handle", None), "entity_id", None)
    return next(
        (run for run in stacks.coroutines.suspended if number and run.entity == number), None
    )
