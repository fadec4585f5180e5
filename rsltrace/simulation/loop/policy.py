"""Which of the callbacks that are ready runs next: one small class per rule.

A policy is asked whenever something may run. It sees everything that may run now, in the order in
which it became ready, timers that are due last, and names one. ``docs/policies.md`` shows how to
write one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, NamedTuple, Protocol

from rsltrace.simulation.chance.stream import Stream


@dataclass(frozen=True, slots=True)
class Candidate:
    """Something that may run now.

    ``node`` and ``entity`` are names (``/planner``; ``/scan``, ``Planner.on_timer``), ``kind`` is
    ``timer``, ``subscription``, ``service``, ``client``, …; ``entity_id`` is the trace's.
    ``period_ns`` is a timer's period, for others that of their node's fastest timer, or None.
    ``group`` are the names of the entities in its callback group. ``thread`` tells apart callbacks
    of one entity that are under way at the same time (``threads: {switch: every_line}``).
    ``executor`` tells apart the simulated executors, where there are any.
    """

    node: str
    entity: str
    kind: str
    entity_id: int
    period_ns: int | None
    group: tuple[str, ...]
    item: Any
    thread: int = 0
    executor: str = ""


class Moment(NamedTuple):
    """When a policy is asked: simulated time, and how many events have run."""

    now_ns: int
    events: int


class Policy(Protocol):
    """Chooses what runs next."""

    def choose(self, ready: Sequence[Candidate], moment: Moment) -> int:
        """Return the index of the one to run; ``ready`` is never empty."""


class Fifo:
    """First come, first served; timers when nothing else is ready."""

    def choose(self, ready: Sequence[Candidate], moment: Moment) -> int:
        return 0


@dataclass(frozen=True, slots=True)
class PriorityRule:
    """A priority for what the globs describe; ``group_of`` means everything in the callback group
    of that entity."""

    priority: int
    node: str = "*"
    entity: str | None = None
    group_of: str | None = None

    def fits(self, candidate: Candidate) -> bool:
        """Whether the rule is about ``candidate``."""
        if not fnmatchcase(candidate.node, self.node):
            return False
        if self.entity is not None:
            return fnmatchcase(candidate.entity, self.entity)
        if self.group_of is not None:
            return any(fnmatchcase(name, self.group_of) for name in candidate.group)
        return True


class Priority:
    """The highest priority first, equal ones in order of arrival. The first fitting rule counts."""

    def __init__(self, rules: Sequence[PriorityRule], default: int = 0) -> None:
        self._rules = tuple(rules)
        self._default = default

    def choose(self, ready: Sequence[Candidate], moment: Moment) -> int:
        return max(range(len(ready)), key=lambda i: (self.priority(ready[i]), -i))

    def priority(self, candidate: Candidate) -> int:
        """Return the priority of something that may run."""
        for rule in self._rules:
            if rule.fits(candidate):
                return rule.priority
        return self._default


class RateMonotonic:
    """The shortest period first; what has none comes last, in order of arrival.

    A message has the period of the timer that it came of (``follows_chains``: the middleware sees
    to that).
    """

    follows_chains = True

    def choose(self, ready: Sequence[Candidate], moment: Moment) -> int:
        return min(range(len(ready)), key=lambda i: (self._period(ready[i]), i))

    def _period(self, candidate: Candidate) -> float:
        return float("inf") if candidate.period_ns is None else candidate.period_ns


class Permutation:
    """What is ready at one instant runs in an order that a seeded stream decides."""

    def __init__(self, stream: Stream) -> None:
        self._below = stream.below

    def choose(self, ready: Sequence[Candidate], moment: Moment) -> int:
        return self._below(len(ready)) if len(ready) > 1 else 0
