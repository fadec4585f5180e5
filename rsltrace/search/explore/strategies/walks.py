"""Random orders: a walk that chooses among all that could run, and PCT with its guarantee."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rsltrace.search.explore.strategies.strategy import Proposal, choices_left
from rsltrace.search.explore.trial import TrialResult
from rsltrace.simulation.loop.search_policies import pct_bound


class _ByNumber:
    """A strategy whose trials follow from their numbers."""

    behaviours = False
    steps = False

    def __init__(self, seed: int, after: str | None) -> None:
        """``after``: the simulated time up to which the order is the plain one, and the job's own
        seed counts."""
        self._seed = seed
        self._after = after

    def _proposal(self, policy: Mapping[str, Any], number: int, what: str) -> Proposal:
        seed = self._seed + number
        if self._after is None:
            order = policy.get("order", dict(policy))
            return Proposal({"policy": order, "seed": seed}, f"{what}, seed {seed}")
        order = {**policy, "after": self._after, "seed": seed}
        return Proposal({"policy": order}, f"{what} after {self._after}, seed {seed}")

    def begin(self, plain: TrialResult) -> None:
        """See that there is something to choose."""
        choices_left(plain)

    def learn(self, result: TrialResult) -> TrialResult | None:
        """Learn nothing."""
        return None


class RandomWalk(_ByNumber):
    """``policy: permutation``, with the number of the trial as seed: delays and the like are drawn
    anew, too."""

    def __init__(self, seed: int = 0, after: str | None = None) -> None:
        super().__init__(seed, after)
        self._tried = 0

    def propose(self, number: int) -> Proposal | None:
        self._tried += 1
        return self._proposal({"order": "permutation"}, number, "random order")

    def coverage(self) -> list[str]:
        return [f"random walk: {self._tried} seeds"] if self._tried else []

    def recall(self, result: TrialResult) -> None:
        policy = result.trial.overlay.get("policy")
        order = policy.get("order") if isinstance(policy, Mapping) else policy
        self._tried += order == "permutation"


class PctWalk(_ByNumber):
    """``policy: {pct: …}`` of depths from 1 to ``depth`` in turn, with other seeds."""

    def __init__(self, depth: int = 3, seed: int = 0, after: str | None = None) -> None:
        super().__init__(seed, after)
        self._depth = depth
        self._choices, self._entities = 1, 1
        self._tried = [0] * depth

    def begin(self, plain: TrialResult) -> None:
        self._choices = max(choices_left(plain), 1)
        self._entities = max(plain.entities, 1)

    def propose(self, number: int) -> Proposal | None:
        depth = 1 + number % self._depth
        self._tried[depth - 1] += 1
        policy = {"pct": {"depth": depth, "choices": self._choices}}
        return self._proposal(policy, number, f"PCT of depth {depth}")

    def recall(self, result: TrialResult) -> None:
        policy = result.trial.overlay.get("policy")
        if isinstance(policy, Mapping) and "pct" in policy:
            self._tried[policy["pct"]["depth"] - 1] += 1

    def coverage(self) -> list[str]:
        lines = []
        for depth, runs in enumerate(self._tried, 1):
            if runs:
                bound = pct_bound(self._entities, self._choices, depth)
                least = 1 - (1 - bound) ** runs
                lines.append(
                    f"PCT: a bug of depth {depth} is found with a probability of at least "
                    f"{bound:.2g} by one run, {least:.2g} by these {runs} "
                    f"({self._entities} entities, {self._choices} choices)"
                )
        return lines
