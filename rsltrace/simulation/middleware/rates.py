"""At what rate chains run: a message has the period of the timer that it came of.

The rate of a subscription (service, client) is the fastest of the chains that have reached it so
far, that of a timer its own; of what no timer has caused (bags, drivers), its node's fastest timer.
"""

from __future__ import annotations

from array import array
from typing import Any

from rsltrace.simulation.middleware.entity import Runnable
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.observer import EventCall, EventObserver, ObserverOrder
from rsltrace.simulation.middleware.receiver import Receiver

_UNKNOWN = -1


def follows_chains(policy: object) -> bool:
    """Whether a policy wants the periods of chains (``Rates``)."""
    return bool(getattr(policy, "follows_chains", False))


class Rates(EventObserver):
    """Follows which period each event goes back to."""

    order = ObserverOrder.RATES

    def __init__(self, dispatcher: Dispatcher) -> None:
        self._loop = dispatcher.loop
        self._of_events = array("q")
        self._of_entities: dict[int, int] = {}
        dispatcher.add_observer(self)

    def period(self, item: Any, what: Runnable) -> int | None:
        """Return the period (ns) of something that may run; its latest arrival counts, too."""
        if what.kind == "timer" and what.period_ns is not None:
            self._of_entities[what.entity] = what.period_ns
        elif isinstance(item, Receiver) and item.queue:
            period_ns = self._of_event(item.queue[-1][item.origin][0])
            known = self._of_entities.get(what.entity, period_ns)
            if period_ns is not None and known is not None:
                self._of_entities[what.entity] = min(known, period_ns)
        return self._of_entities.get(what.entity, what.period_ns)

    def _of_event(self, event: int) -> int | None:
        known = event < len(self._of_events) and self._of_events[event] != _UNKNOWN
        return self._of_events[event] if known else None

    def before_event(self, call: EventCall) -> bool:
        """Take note of the event's period."""
        period_ns = self._of_entities.get(call.entity)
        if period_ns is None:
            period_ns = self._of_event(call.cause_event)
        missing = self._loop.events - len(self._of_events)
        self._of_events.extend((_UNKNOWN,) * missing)
        self._of_events.append(_UNKNOWN if period_ns is None else period_ns)
        return True
