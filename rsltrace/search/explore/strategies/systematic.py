"""All orders that could matter, each once: dynamic partial-order reduction over phases of a run.

A phase ends when nothing is left to run: steps of different phases cannot swap. So the phases are
searched one by one, and a phase that begins in a known state is skipped.

Within a phase, two orders that differ only in neighbours that commute (see ``steps``) end in the
same state, and one of them is run. Which others to run is decided as by Abdulla et al. (Optimal
dynamic partial order reduction, POPL 2014): where two steps that do not commute could be swapped,
the step that must come first for that is tried (source sets), and what has been tried before is
not tried again after steps that it commutes with (sleep sets).
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rsltrace.search.explore.steps import EVERYTHING
from rsltrace.search.explore.strategies.strategy import Proposal, Strategy, choices_left
from rsltrace.search.explore.trial import TrialResult, TrialStep

Touches = Mapping[str, bool]
_Departures = tuple[tuple[int, int], ...]


@dataclass(slots=True)
class _OrderNode:
    """A step in the tree of orders of one phase. ``departures`` lead to it."""

    parent: _OrderNode | None
    departures: _Departures
    choice: int
    ready: tuple[str, ...]
    sleep: dict[str, Touches]
    begun: set[str] = field(default_factory=set)
    tried: dict[str, Touches] = field(default_factory=dict)

    def path(self) -> list[_OrderNode]:
        """Return the nodes from the beginning of the phase up to this one."""
        found = [self]
        while found[-1].parent is not None:
            found.append(found[-1].parent)
        return found[::-1]

    def enabled(self) -> list[str]:
        """Return what could run: of each entity the first event."""
        first: dict[str, str] = {}
        for name in self.ready:
            first.setdefault(_entity(name), name)
        return list(first.values())


@dataclass(frozen=True, slots=True)
class _Order:
    """An order to try: at ``node``, ``key`` runs next. ``asleep`` was tried there before."""

    node: _OrderNode
    key: str
    asleep: Mapping[str, Touches]


class Systematic(Strategy):
    """Tries orders with the fewest departures from the plain one first (``departures_max``)."""

    steps = True

    def __init__(self, departures_max: int | None = None) -> None:
        self._max = departures_max
        self._first = 0
        """The first choice that may be changed."""
        self._count = itertools.count()
        self._waiting: list[tuple[int, int, _OrderNode, str]] = []
        self._under_way: dict[str, _Order] = {}
        self._again: list[Proposal] = []
        """What was under way when the search was left."""
        self._states: set[str] = set()
        self.finals: set[str] = set()
        self.runs = self.redundant = self.merged = self.beyond = 0
        self.orders_log10 = 0.0
        """Logarithm of an estimate of how many orders there are (Knuth, 1975)."""

    # -- the interface ---------------------------------------------------------------------------

    def begin(self, plain: TrialResult) -> None:
        """Find the orders to try in the plain run."""
        choices_left(plain)
        self._first = plain.choices_before
        self.runs += 1
        self.finals.add(plain.final_state)
        self._follow(plain.steps, None)

    def propose(self, number: int) -> Proposal | None:
        return self._again.pop(0) if self._again else self._next()

    def _next(self) -> Proposal | None:
        while self._waiting:
            _, _, node, key = heapq.heappop(self._waiting)
            if key in node.sleep:
                continue
            index = node.ready.index(key)
            taken = (*node.departures, *(((node.choice, index),) if index else ()))
            if self._max is not None and len(taken) > self._max:
                self.beyond += 1
                continue
            overlay = {"policy": {"departures": [{"choice": c, "run": r} for c, r in taken]}}
            asleep = {**node.sleep, **node.tried}
            self._under_way[_key(overlay)] = _Order(node, key, asleep)
            return Proposal(overlay, f"systematic, {len(taken)} departures")
        return None

    def learn(self, result: TrialResult) -> TrialResult | None:
        item = self._under_way.pop(_key(result.trial.overlay), None)
        if item is not None:
            self.runs += 1
            self.finals.add(result.final_state)
            self._follow(result.steps, item)
        return result

    def recall(self, result: TrialResult) -> None:
        key = _key(result.trial.overlay)
        while key not in self._under_way:
            proposal = self._next()
            if proposal is None:
                return
            if _key(proposal.overlay) != key:
                self._again.append(proposal)
        self._again = [one for one in self._again if _key(one.overlay) != key]
        self.learn(result)

    @property
    def finished(self) -> bool:
        """Whether everything has been tried, up to the bound."""
        return not self._waiting and not self._under_way

    def coverage(self) -> list[str]:
        all_orders = f"about 1e{self.orders_log10:.0f}" if self.orders_log10 > 6 else ""
        all_orders = all_orders or f"about {10**self.orders_log10:.0f}"
        lines = [
            f"systematic: {self.runs} runs stand for {all_orders} orders, {len(self.finals)} "
            f"different ends; {self.merged} phases began in a known state, {self.redundant} runs "
            "repeated one before in an equivalent order"
        ]
        left = len(self._waiting) + len(self._under_way)
        if self._first:
            lines.append(f"not covered: orders that change the first {self._first} choices")
        if self.beyond:
            lines.append(f"not covered: {self.beyond} orders with more than {self._max} departures")
        lines.append(f"not covered: {left} orders yet to try" if left else "covered: all others")
        return lines

    # -- what is to be tried ---------------------------------------------------------------------

    def _follow(self, steps: Sequence[TrialStep], item: _Order | None) -> None:
        """Go through a run, from the phase of the item (None: from the beginning)."""
        self._estimate(steps)
        departures: list[tuple[int, int]] = []
        choice = 0
        is_beyond = item is None
        for phase in _phases(steps):
            nodes_before = tuple(departures)
            first = choice
            for step in phase:
                if len(step.ready) > 1:
                    if step.chosen:
                        departures.append((choice, step.chosen))
                    choice += 1
            if choice <= self._first and self._first:
                continue  # it is the same in all runs
            if not is_beyond:
                assert item is not None
                is_beyond = first <= item.node.choice < choice
                if is_beyond and not self._search(phase, nodes_before, first, item):
                    return
            elif phase[0].state in self._states:
                self.merged += 1
                return
            else:
                self._states.add(phase[0].state)
                self._search(phase, nodes_before, first, None)

    def _search(
        self, phase: Sequence[TrialStep], departures: _Departures, choice: int, item: _Order | None
    ) -> bool:
        """Follow a phase, and find where it could continue differently; False: it is not new."""
        path, is_new = self._path(phase, departures, choice, item)
        self._reverse(phase[: len(path)], path)
        return is_new

    def _path(
        self, phase: Sequence[TrialStep], departures: _Departures, choice: int, item: _Order | None
    ) -> tuple[list[_OrderNode], bool]:
        """Return the nodes of a phase, from that of the item on, up to what has been tried."""
        path = [] if item is None else item.node.path()
        known = len(path)
        sleep: dict[str, Touches] = {}
        taken = list(departures)
        for index, step in enumerate(phase):
            key = step.ready[step.chosen]
            if index >= known:
                parent = path[-1] if path else None
                node = _OrderNode(parent, tuple(taken), choice, step.ready, sleep, {key})
                if key in sleep:
                    self.redundant += 1
                    self._instead(node)
                    return path, False
                path.append(node)
            if index >= known - 1:
                path[index].tried[key] = step.touches
                before = item.asleep if item is not None and index == known - 1 else sleep
                sleep = {k: t for k, t in before.items() if k != key and commute(t, step.touches)}
            if len(step.ready) > 1:
                if step.chosen:
                    taken.append((choice, step.chosen))
                choice += 1
        return path, True

    def _instead(self, node: _OrderNode) -> None:
        """What runs has been tried: try a step that has not, if there is one."""
        others = [name for name in node.enabled() if name not in node.sleep]
        if others:
            self._try(node, others[0])

    def _try(self, node: _OrderNode, key: str) -> None:
        if key not in node.begun and len(node.ready) > 1 and node.choice >= self._first:
            node.begun.add(key)
            index = node.ready.index(key)
            count = len(node.departures) + (index > 0)
            heapq.heappush(self._waiting, (count, next(self._count), node, key))

    def _reverse(self, steps: Sequence[TrialStep], path: Sequence[_OrderNode]) -> None:
        """Where two steps do not commute, also try the second one first."""
        after = _happens_after(steps)
        for second in range(len(steps)):
            for first in _races(steps, after, second):
                node = path[first]
                if len(node.ready) < 2:
                    continue
                between = [k for k in range(first + 1, second) if first not in after[k]]
                initials = _initials(steps, after, [*between, second])
                if not any(key in node.begun or key in node.sleep for key in initials):
                    possible = [key for key in node.enabled() if key in initials]
                    for key in possible[:1] or node.enabled():
                        self._try(node, key)

    def _estimate(self, steps: Sequence[TrialStep]) -> None:
        log10 = sum(math.log10(len({_entity(name) for name in step.ready})) for step in steps)
        self.orders_log10 = max(self.orders_log10, log10)


def commute(one: Touches, other: Touches) -> bool:
    """Whether two steps can swap: neither writes what the other touches."""
    if EVERYTHING in one or EVERYTHING in other:
        return False
    if len(other) < len(one):
        one, other = other, one
    return not any(place in other and (writes or other[place]) for place, writes in one.items())


def _happens_after(steps: Sequence[TrialStep]) -> list[set[int]]:
    """Return, for each step of a phase, the earlier ones that must stay before it."""
    after: list[set[int]] = []
    for index, step in enumerate(steps):
        before: set[int] = set()
        for other in range(index - 1, -1, -1):
            if other not in before and not commute(steps[other].touches, step.touches):
                before |= after[other]
                before.add(other)
        after.append(before)
    return after


def _races(steps: Sequence[TrialStep], after: Sequence[set[int]], second: int) -> Iterator[int]:
    """Yield the steps that do not commute with ``second``, with nothing between them."""
    entity = _entity(_ran(steps[second]))
    for first in after[second]:
        if any(first in after[k] for k in after[second] if k != first):
            continue
        if _entity(_ran(steps[first])) != entity:
            yield first


def _initials(
    steps: Sequence[TrialStep], after: Sequence[set[int]], chosen: Sequence[int]
) -> frozenset[str]:
    """Return the steps among ``chosen`` that none of the others must precede."""
    there = set(chosen)
    return frozenset(_ran(steps[k]) for k in chosen if not after[k] & there)


def _phases(steps: Sequence[TrialStep]) -> Iterator[list[TrialStep]]:
    for _, phase in itertools.groupby(steps, key=lambda step: step.phase):
        yield list(phase)


def _ran(step: TrialStep) -> str:
    return step.ready[step.chosen]


def _entity(name: str) -> str:
    return name.rpartition(" #")[0]


def _key(overlay: Mapping[str, Any]) -> str:
    policy = overlay.get("policy") or {}
    if not isinstance(policy, Mapping):
        return str(policy)
    return str([(one["choice"], one["run"]) for one in policy.get("departures") or ()])
