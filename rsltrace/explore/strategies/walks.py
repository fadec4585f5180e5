"""Random orders: a walk that chooses among all that could run, and PCT with its guarantee."""

from __future__ import annotations

from collections.abc import Mapping

from rsltrace.explore.strategies.strategy import Proposal
from rsltrace.explore.trial import TrialResult
from rsltrace.loop.search_policies import pct_bound


class _ByNumber:
    """A strategy whose trials follow from their numbers."""

    behaviours = False
    steps = False

    def begin(self, plain: TrialResult) -> None:
        """Need nothing of the plain run."""

    def learn(self, result: TrialResult) -> TrialResult | None:
        """Learn nothing."""
        return None


class RandomWalk(_ByNumber):
    """``policy: permutation``, with the number of the trial as seed: delays and the like are drawn
    anew, too."""

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self._tried = 0

    def propose(self, number: int) -> Proposal | None:
        seed = self._seed + number
        self._tried += 1
        return Proposal({"policy": "permutation", "seed": seed}, f"random order, seed {seed}")

    def coverage(self) -> list[str]:
        return [f"random walk: {self._tried} seeds"] if self._tried else []

    def recall(self, result: TrialResult) -> None:
        self._tried += result.trial.overlay.get("policy") == "permutation"


class PctWalk(_ByNumber):
    """``policy: {pct: …}`` of depths from 1 to ``depth`` in turn, with other seeds."""

    def __init__(self, depth: int = 3, seed: int = 0) -> None:
        self._depth = depth
        self._seed = seed
        self._choices, self._entities = 1, 1
        self._tried = [0] * depth

    def begin(self, plain: TrialResult) -> None:
        self._choices = max(plain.choices, 1)
        self._entities = max(plain.entities, 1)

    def propose(self, number: int) -> Proposal | None:
        seed, depth = self._seed + number, 1 + number % self._depth
        self._tried[depth - 1] += 1
        policy = {"pct": {"depth": depth, "choices": self._choices}}
        return Proposal({"policy": policy, "seed": seed}, f"PCT of depth {depth}, seed {seed}")

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
