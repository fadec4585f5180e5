"""A run that follows the order of a native one as far as it can."""

from __future__ import annotations

from collections.abc import Iterator

from rsltrace.simulation.loop.observed_order import ObservedOrder
from rsltrace.simulation.loop.ordered import OrderedLoop
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder


class ObservedRun(EventObserver):
    """Tells an order of what has run, and lets the loop wait for whose turn it is."""

    order = ObserverOrder.RECORDED_ORDER

    def __init__(self, dispatcher: Dispatcher, order: ObservedOrder) -> None:
        self.policy = order
        self._dispatcher = dispatcher
        dispatcher.add_observer(self)
        assert isinstance(dispatcher.loop, OrderedLoop), "a job with a policy has one"
        dispatcher.loop.hold_until = order.hold_until

    def after_event(self) -> None:
        """Take note of the event."""
        dispatcher = self._dispatcher
        if dispatcher.outcome.ended_after is None:
            event = dispatcher.event
            self.policy.happened(event.kind, event.entity, dispatcher.loop.now_ns)

    def notes(self) -> Iterator[str]:
        """Yield how far the order was followed."""
        yield from self.policy.notes()
