"""Policies of a search for the order that fails: departures from the plain order, and PCT.

Both count choices: the times at which more than one could run. Where only one can, there is nothing
to choose, and nothing is counted.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rsltrace.errors import RunError
from rsltrace.simulation.chance.stream import Stream
from rsltrace.simulation.loop.policy import Candidate, Moment, Policy
from rsltrace.trace.model.stamp import format_seconds

_SHOWN = 5


@dataclass(frozen=True, slots=True)
class Departure:
    """At choice number ``choice`` (from 0) the candidate number ``run`` runs, not the first.

    ``of`` is its name as ``name_of`` gives it, where that is to be checked.
    """

    choice: int
    run: int
    of: str | None = None


def name_of(candidate: Candidate) -> str:
    """Name a candidate: node and entity, ``/planner /scan``; what has neither by its kind."""
    return " ".join(filter(None, (candidate.node, candidate.entity))) or candidate.kind


class Departures:
    """First come, first served, timers last, but for the departures that are given.

    :raises RunError: from ``choose``, if a departure names what cannot run then.
    """

    def __init__(self, departures: Iterable[Departure]) -> None:
        self._departures = {one.choice: one for one in departures}
        self.choices = 0
        """How many choices there have been."""

    def choose(self, ready: Sequence[Candidate], moment: Moment) -> int:
        if len(ready) == 1:
            return 0
        departure = self._departures.get(self.choices)
        self.choices += 1
        if departure is None:
            return 0
        fits = departure.run < len(ready)
        if not fits or departure.of not in (None, name_of(ready[departure.run])):
            raise _cannot_depart(departure, ready, moment)
        return departure.run

    def unmet(self) -> list[int]:
        """Return the choices of departures that the run has not come to."""
        return sorted(choice for choice in self._departures if choice >= self.choices)


def _cannot_depart(departure: Departure, ready: Sequence[Candidate], moment: Moment) -> RunError:
    what = f"candidate {departure.run}" + (f" ({departure.of})" if departure.of else "")
    names = ", ".join(f"{i}: {name_of(one)}" for i, one in enumerate(ready[:_SHOWN]))
    more = ", …" if len(ready) > _SHOWN else ""
    return RunError(
        f"policy: departures: choice {departure.choice} cannot be {what}: at "
        f"{format_seconds(moment.now_ns)} s (event {moment.events}) ready are {names}{more}. "
        "Nodes, job or input differ from those that the departures were made for"
    )


class After:
    """First come, first served up to ``time_ns``; what comes later is for another policy, which is
    not asked before."""

    def __init__(self, time_ns: int, policy: Policy) -> None:
        self._time_ns = time_ns
        self._policy = policy
        self.follows_chains = getattr(policy, "follows_chains", False)
        self.polls_from_ns = time_ns if hasattr(policy, "polls_from_ns") else None
        self.forget = getattr(policy, "forget", None)

    def choose(self, ready: Sequence[Candidate], moment: Moment) -> int:
        return 0 if moment.now_ns <= self._time_ns else self._policy.choose(ready, moment)


class Pct:
    """Probabilistic concurrency testing (Burckhardt et al., ASPLOS 2010).

    Each entity has a random priority, the highest runs. At ``depth`` - 1 choices, drawn among the
    first ``choices``, whoever would run gets a priority below all others instead. Each entity runs
    its events in the order of their arrival, so it is what a thread is there: an order that needs
    ``depth`` constraints is met with a probability of at least 1 / (entities x choices^(depth-1)).
    """

    def __init__(self, stream: Stream, depth: int, choices: int) -> None:
        self._stream = stream
        self._choices = 0
        self._changes: dict[int, list[int]] = {}
        for rank in range(depth - 1):
            self._changes.setdefault(stream.below(choices), []).append(rank)
        self._depth = depth
        self._priorities: dict[tuple[int, int], float] = {}

    def choose(self, ready: Sequence[Candidate], moment: Moment) -> int:
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
    """Return the least probability with which one run of ``Pct`` meets an order of that depth."""
    return 1.0 / (max(entities, 1) * float(max(choices, 1)) ** (depth - 1))
