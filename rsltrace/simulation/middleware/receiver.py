"""Entities for which something arrives: the queue between the loop and their callback."""

from __future__ import annotations

from collections import deque
from typing import Any

from rsltrace.simulation.middleware.entity import DomainEntity


class Receiver(DomainEntity):
    """An entity with a queue of what has arrived for its callback.

    One entry in the loop's ready queue stands for one arrival, so arrivals of all entities run in
    the order in which they came. An arrival that the queue has dropped leaves an entry behind that
    finds nothing to do.
    """

    queue: deque[Any]
    keep: int | None = None
    """How many arrivals the queue holds; a full one drops its oldest. None: all."""
    origin = slice(1, 4)
    """Where an arrival says what it is: publishing event, which of its outputs, content hash."""

    def deliver(self, arrival: Any) -> None:
        """Queue an arrival; it is dispatched once its participant is being run."""
        if self.arrived(arrival) is not None:
            self.dispatcher.loop.ready.append(self)

    def arrived(self, arrival: Any) -> Receiver | None:
        """Queue an arrival; return this receiver if it is ready for it now."""
        if len(self.queue) == self.keep:
            self.drop()
        self.queue.append(arrival)
        if self.active:
            return self
        self.awaken()
        return None

    def drop(self, held: int = 0) -> None:
        """Count what is dropped by the full queue, or by that of a publisher which holds so many
        messages in an outage."""
        drops = self.dispatcher.outcome.drops
        drops[self, held] = drops.get((self, held), 0) + 1

    def awaken(self) -> None:
        """Become active if that is possible by now: something has arrived."""

    def activate(self) -> None:
        """Let the loop hear of what has arrived so far."""
        self.dispatcher.loop.ready.extend([self] * len(self.queue))

    def may_run(self) -> bool:
        """Return whether to take an arrival now."""
        return bool(self.queue) and self.active and not self.destroyed

    def settle(self) -> bool:
        return True

    def dispatch(self) -> None:
        """Take the oldest arrival and run the callback with it."""
        raise AssertionError("every receiver says how")
