"""Which of the ready callbacks runs next: one class per rule.

A policy sees everything that may run now, in the order in which it became ready, due timers last,
and chooses one. ``docs/policies.md`` shows how to write one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatchcase
from typing import Any, NamedTuple, Protocol

from rsltrace.errors import RunError
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.trace.model.texts import format_seconds

# A policy's choices are recorded, one byte each. A trace's events are not enough to repeat them:
# what is handed to one of the user's own executors, or wakes a polling call, has no event.

_LARGE = 255
"""Stands for a choice that needs more than one byte, which follows in four."""


class PolicyChoices:
    """The choices of a run so far. Where only one callback could run there was none."""

    def __init__(self) -> None:
        self._data = bytearray()

    def __bool__(self) -> bool:
        return bool(self._data)

    def add(self, index: int) -> None:
        """Remember that the policy chose ``index``."""
        if index < _LARGE:
            self._data.append(index)
        else:
            self._data.append(_LARGE)
            self._data += index.to_bytes(4, "little")

    def encoded(self) -> bytes:
        return bytes(self._data)


def decode_choices(data: bytes) -> Iterator[int]:
    at = 0
    while at < len(data):
        index, at = data[at], at + 1
        if index == _LARGE:
            index, at = int.from_bytes(data[at : at + 4], "little"), at + 4
        yield index


@dataclass(frozen=True, slots=True)
class Candidate:
    """Something that may run now.

    ``node`` and ``entity`` are names (``/planner``; ``/scan``, ``Planner.on_timer``), ``kind`` is
    ``timer``, ``subscription``, ``service``, ``client``, …; ``entity_id`` is the trace's.
    ``period_ns`` is a timer's period, for others that of their node's fastest timer, or None.
    ``group`` are the names of the entities in its callback group. ``thread`` distinguishes
    callbacks of one entity that are under way at the same time (``threads: {switch: every_line}``).
    ``executor`` distinguishes the simulated executors, where there are any.
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


class ChoicePoint(NamedTuple):
    """When a policy is asked: simulated time, how many events have run, the start of the run."""

    now_ns: int
    events: int
    start_ns: int = 0

    @property
    def seconds(self) -> str:
        """The time since the start of the run."""
        return format_seconds(self.now_ns - self.start_ns)


class ExecutionPolicy(Protocol):
    """Chooses what runs next."""

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        """Return the index of the one to run; ``ready`` is never empty."""


class Fifo:
    """First come, first served; timers when nothing else is ready."""

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
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

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        return max(range(len(ready)), key=lambda i: (self.priority(ready[i]), -i))

    def priority(self, candidate: Candidate) -> int:
        for rule in self._rules:
            if rule.fits(candidate):
                return rule.priority
        return self._default


class RateMonotonic:
    """The shortest period first; what has none comes last, in order of arrival.

    A message has the period of the timer that caused it (``follows_chains``).
    """

    follows_chains = True

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        never = float("inf")
        periods = [never if one.period_ns is None else one.period_ns for one in ready]
        return periods.index(min(periods))


class Permutation:
    """What is ready at one instant runs in an order that a seeded stream decides."""

    def __init__(self, stream: RandomStream) -> None:
        self._below = stream.below

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        return self._below(len(ready)) if len(ready) > 1 else 0


# Search policies. Both count choices: the times at which more than one callback could run.

_SHOWN = 5


@dataclass(frozen=True, slots=True)
class Departure:
    """At choice number ``choice`` (from 0) the candidate number ``run`` runs, not the first.

    ``of`` is its name as ``candidate_name`` gives it, where that is to be checked.
    """

    choice: int
    run: int
    of: str | None = None


def candidate_name(candidate: Candidate) -> str:
    """Name a candidate by node and entity (``/planner /scan``), or else by its kind."""
    return " ".join(filter(None, (candidate.node, candidate.entity))) or candidate.kind


class Departures:
    """First come, first served, timers last, except for the given departures.

    :raises RunError: from ``choose``, if a departure's candidate cannot run then.
    """

    def __init__(self, departures: Iterable[Departure]) -> None:
        self._departures = {one.choice: one for one in departures}
        self.choices = 0
        """How many choices there have been."""

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        if len(ready) == 1:
            return 0
        departure = self._departures.get(self.choices)
        self.choices += 1
        if departure is None:
            return 0
        fits = departure.run < len(ready)
        if not fits or departure.of not in (None, candidate_name(ready[departure.run])):
            raise _cannot_depart(departure, ready, moment)
        return departure.run

    def unmet(self) -> list[int]:
        """Return the choice numbers that the run has not reached."""
        return sorted(choice for choice in self._departures if choice >= self.choices)


def _cannot_depart(
    departure: Departure, ready: Sequence[Candidate], moment: ChoicePoint
) -> RunError:
    what = f"candidate {departure.run}" + (f" ({departure.of})" if departure.of else "")
    names = ", ".join(f"{i}: {candidate_name(one)}" for i, one in enumerate(ready[:_SHOWN]))
    more = ", …" if len(ready) > _SHOWN else ""
    return RunError(
        f"policy: departures: choice {departure.choice} cannot be {what}: at "
        f"{moment.seconds} s (event {moment.events}) ready are {names}{more}. "
        "Nodes, job or input differ from those that the departures were made for"
    )


class FifoUntil:
    """First come, first served up to ``time_ns``, then another policy."""

    def __init__(self, time_ns: int, policy: ExecutionPolicy) -> None:
        self._time_ns = time_ns
        self._policy = policy
        self.follows_chains = getattr(policy, "follows_chains", False)
        self.polls_from_ns = time_ns if hasattr(policy, "polls_from_ns") else None
        self.forget = getattr(policy, "forget", None)

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        return 0 if moment.now_ns <= self._time_ns else self._policy.choose(ready, moment)


class Pct:
    """Probabilistic concurrency testing (Burckhardt et al., ASPLOS 2010).

    Each entity has a random priority, the highest runs. At ``depth`` - 1 choices, drawn among the
    first ``choices``, whoever would run gets a priority below all others instead. Each entity runs
    its events in the order of their arrival, so it is what a thread is there: an order that needs
    ``depth`` constraints is met with a probability of at least 1 / (entities x choices^(depth-1)).
    """

    def __init__(self, stream: RandomStream, depth: int, choices: int) -> None:
        self._stream = stream
        self._choices = 0
        self._changes: dict[int, list[int]] = {}
        for rank in range(depth - 1):
            self._changes.setdefault(stream.below(choices), []).append(rank)
        self._depth = depth
        self._priorities: dict[tuple[int, int], float] = {}

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        for one in ready:
            if (one.entity_id, one.thread) not in self._priorities:
                self._priorities[one.entity_id, one.thread] = self._depth + self._stream.uniform()
        if len(ready) == 1:
            return 0
        chosen = self._highest(ready)
        for rank in self._changes.get(self._choices, ()):
            self._priorities[ready[chosen].entity_id, ready[chosen].thread] = rank
            chosen = self._highest(ready)
        self._choices += 1
        return chosen

    def _highest(self, ready: Sequence[Candidate]) -> int:
        def priority(index: int) -> tuple[float, int]:
            one = ready[index]
            return self._priorities[one.entity_id, one.thread], -index

        return max(range(len(ready)), key=priority)


def pct_bound(entities: int, choices: int, depth: int) -> float:
    """Return the minimum probability that one run of ``Pct`` finds an order of that depth."""
    return 1.0 / (max(entities, 1) * float(max(choices, 1)) ** (depth - 1))
