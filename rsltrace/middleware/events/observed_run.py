"""A run that follows the order of a native one as far as it can."""

from __future__ import annotations

from collections.abc import Iterator

from rsltrace.loop.observed_order import ObservedOrder
from rsltrace.loop.ordered import OrderedLoop
from rsltrace.middleware.events.dispatcher import Dispatcher


class ObservedRun:
    """Tells an order of what has run, and lets the loop wait for whose turn it is."""

    def __init__(self, dispatcher: Dispatcher, order: ObservedOrder) -> None:
        self.order = order
        self._dispatcher = dispatcher
        self._end_event = dispatcher.end_event
        dispatcher.end_event = self._told  # type: ignore[method-assign]
        assert isinstance(dispatcher.loop, OrderedLoop), "a job with a policy has one"
        dispatcher.loop.hold_until = order.hold_until

    def _told(self) -> None:
        """Stand in for ``Dispatcher.end_event``: end the event, then take note of it."""
        event, now_ns = self._dispatcher.event, self._dispatcher.loop.now_ns
        kind, entity = event.kind, event.entity
        self._end_event()
        if self._dispatcher.outcome.ended_after is None:
            self.order.happened(kind, entity, now_ns)

    def notes(self) -> Iterator[str]:
        """Yield how far the order was followed."""
        yield from self.order.notes()
