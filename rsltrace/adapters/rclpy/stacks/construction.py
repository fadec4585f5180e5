"""Events in which the code of a job's entry runs: its constructor, its main, its threads."""

from __future__ import annotations

from collections.abc import Callable

from rsltrace.adapters.rclpy.entry import Entry
from rsltrace.simulation.middleware.events.event import Event, OutsideEvent
from rsltrace.trace.model.finding import Policy


class Construction(OutsideEvent):
    """An event that is no entity's callback; ``entry`` is what is being constructed, or None."""

    def __init__(self, describe: Callable[[], str], entry: Entry | None) -> None:
        super().__init__(describe)
        self.entry = entry


def policy_of(event: Event) -> Policy | None:
    """Return the guard's policy for whoever runs, or None for the job's."""
    if event.node is not None:
        return getattr(event.node, "policy", None)
    entry = entry_of(event)
    return entry.policy if entry is not None else None


def entry_of(event: Event) -> Entry | None:
    """Return the entry of the job whose constructor runs, as long as it has made no node."""
    return getattr(event.handle, "entry", None)
