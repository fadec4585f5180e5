"""Priorities of native runs: which ready callback an executor takes, and which thread runs first.

Two levels, as a robot has them: among the ready callbacks of one executor the most urgent is taken
(looking again after each, so that no polling point keeps a late one waiting), and the threads of
executors are in the real-time class SCHED_FIFO where the system lets us.
"""

from __future__ import annotations

import math
import os
import resource
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import Any

from rsltrace.native.observed_entities import ObservedEntities, ObservedEntity
from rsltrace.native.support import patched
from rsltrace.simulation.loop.policy import Candidate, PriorityRule
from rsltrace.trace.model.entity import EntityKind

LEVEL_MAX, LEVEL_MIN = 89, 10
"""Real-time priorities of executors by rate: 99 and the like are the kernel's own."""
_FASTEST_NS = 100_000
_STEPS_PER_OCTAVE = 4
_SENDS = (
    ("Publisher", "publish"),
    ("Client", "send_request"),
    ("Service", "service_send_response"),
)


def level_of_period(period_ns: float) -> int:
    """Return the real-time priority for a period: one less for each 19 % that it is longer.

    It needs to know of no other executor, so it holds across processes, too.
    """
    if period_ns <= _FASTEST_NS:
        return LEVEL_MAX
    if math.isinf(period_ns):
        return LEVEL_MIN
    steps = math.floor(_STEPS_PER_OCTAVE * math.log2(period_ns / _FASTEST_NS))
    return max(LEVEL_MAX - steps, LEVEL_MIN)


def real_time_class() -> str:
    """Return why threads of this process cannot be in the class SCHED_FIFO, "" if they can."""
    refused: list[str] = []

    def attempt() -> None:
        try:
            _set_level(LEVEL_MAX)
        except OSError as error:
            refused.append(error.strerror or str(error))

    thread = threading.Thread(target=attempt)
    thread.start()
    thread.join()
    if not refused:
        return ""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    return (
        f"no real-time priorities (SCHED_FIFO: {refused[0].lower()}; the limit rtprio is "
        f"{limit}). A line 'YOU - rtprio {LEVEL_MAX}' in /etc/security/limits.d/realtime.conf and "
        f"a new login give them (a service: LimitRTPRIO={LEVEL_MAX}; docker run: --cap-add "
        f"SYS_NICE --ulimit rtprio={LEVEL_MAX})"
    )


def order() -> str:
    """Return what a trace says of the priorities."""
    among = "which ready callback an executor takes"
    return among if real_time_class() else f"SCHED_FIFO for each executor's thread, and {among}"


class Priorities:
    """What is how urgent: by ``rules``, or without any by rate.

    A topic or service has the period of the fastest callback that has sent on it so far; what
    no timer has caused, that of its node's fastest timer. ``refused`` is why no thread is in
    the real-time class, if that is so.
    """

    def __init__(self, entities: ObservedEntities, rules: tuple[PriorityRule, ...] | None) -> None:
        self._entities = entities
        self._rules = rules
        self._periods: dict[str, int] = {}
        self._local = threading.local()
        self.refused = real_time_class()
        self.levels: dict[str, int] = {}
        """The real-time priorities of the executors, by the name of their thread."""
        self.at_end: list[Callable[[], None]] = []
        """What is called when the run is over."""

    @contextmanager
    def watched(self, extension: Any) -> Iterator[None]:
        """Take note of who sends what meanwhile."""
        with ExitStack() as stack:
            for owner, method in _SENDS:
                stack.enter_context(patched(getattr(extension, owner), method, self._sends))
            yield
        for forget in self.at_end:
            forget()

    def _sends(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def send(handle: Any, *words: Any) -> Any:
            period_ns = getattr(self._local, "period_ns", None)
            observed = self._entities.find(handle)
            if period_ns is not None and observed is not None:
                known = self._periods.get(observed.name, period_ns)
                self._periods[observed.name] = min(known, period_ns)
            return original(handle, *words)

        return send

    def urgency(self, entity: Any, node: Any) -> float:
        """Return how urgent something ready is: the lower the more."""
        if self._rules is None:
            return self._period(entity, node)
        observed = self._observed_entity(entity)
        group = [
            self._name(self._observed_entity(one))
            for one in (*node.timers, *node.subscriptions, *node.services, *node.clients)
            if one.callback_group is getattr(entity, "callback_group", None)
        ]
        kind = "" if observed is None else observed.kind.label
        name = node.get_fully_qualified_name()
        candidate = Candidate(name, self._name(observed), kind, 0, None, tuple(group), entity)
        return -next((rule.priority for rule in self._rules if rule.fits(candidate)), 0)

    def _period(self, entity: Any, node: Any) -> float:
        observed = self._observed_entity(entity)
        if observed is not None and observed.kind is EntityKind.TIMER:
            return float(entity.timer_period_ns)
        known = None if observed is None else self._periods.get(observed.name)
        if known is not None:
            return known
        return min((float(timer.timer_period_ns) for timer in node.timers), default=math.inf)

    def runs(self, entity: Any, node: Any) -> None:
        """Take note that a callback is about to run in this thread."""
        period_ns = self._period(entity, node)
        self._local.period_ns = None if math.isinf(period_ns) else int(period_ns)

    def raise_to(self, urgency: float) -> None:
        """Have the present thread run at the real-time priority that goes with an urgency, unless
        it has a higher one."""
        level = level_of_period(urgency)
        if self._rules is not None:
            level = max(min(int(-urgency), LEVEL_MAX), 1)
        name = threading.current_thread().name.removeprefix("rsltrace ")
        if self.refused or level <= self.levels.get(name, 0):
            return
        self.levels[name] = level
        _set_level(level)

    def _observed_entity(self, entity: Any) -> ObservedEntity | None:
        return self._entities.find(entity)

    def _name(self, observed: ObservedEntity | None) -> str:
        return "" if observed is None else observed.name


def _set_level(level: int) -> None:
    """Put the present thread into the class SCHED_FIFO.

    :raises OSError: it may not be.
    """
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(level))
