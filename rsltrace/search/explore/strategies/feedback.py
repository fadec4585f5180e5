"""Orders near those that have shown something new: one more departure from one of them."""

from __future__ import annotations

import json
import random
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rsltrace.search.explore.strategies.strategy import Proposal, choices_left
from rsltrace.search.explore.trial import TrialResult
from rsltrace.trace.chain import hash64

_TRIES = 20
_ORDERS_MAX = 2_000
_NEW_SEEDS = 0.2


class Feedback:
    """Keeps the orders of runs in which something happened that had not happened before (an event
    with its content and its node's state, two events of a node in that order), and departs from
    one of them at one more choice; the newest are taken most often."""

    behaviours = True
    steps = False

    def __init__(self, seed: int = 0, *, is_forked: bool = False) -> None:
        """``is_forked``: runs begin as the plain one, with its seed."""
        self._seed = seed
        self._is_forked = is_forked
        self._first = 0
        self._seen: set[int] = set()
        self._orders: list[tuple[dict[str, Any], tuple[tuple[int, int], ...]]] = []
        """What else sets a run apart (its seed, say), and of each choice which of how many."""
        self._tried: set[int] = set()
        self._runs = self._new_runs = 0

    def begin(self, plain: TrialResult) -> None:
        choices_left(plain)
        self._first = plain.choices_before
        self._keep(plain)

    def propose(self, number: int) -> Proposal | None:
        chance = random.Random(f"{self._seed} {number}")
        overlay: dict[str, Any] = {}
        for _ in range(_TRIES):
            overlay = self._near(chance)
            if self._is_new(overlay):
                break
        words = f"near what was new, {len(overlay['policy']['departures'])} departures"
        if "seed" in overlay:
            words += f", seed {overlay['seed']}"
        return Proposal(overlay, words)

    def _is_new(self, overlay: Mapping[str, Any]) -> bool:
        """Say whether this has not been proposed, and remember that it has."""
        mark = hash64(json.dumps(overlay, sort_keys=True).encode())
        if mark in self._tried:
            return False
        self._tried.add(mark)
        return True

    def _near(self, chance: random.Random) -> dict[str, Any]:
        """Return an overlay: the departures of a run that was kept up to some choice, and one more;
        now and then, and where there is no choice, another seed for what is drawn."""
        orders = [one for one in self._orders if len(one[1]) > self._first]
        if self._is_forked and not orders:
            return {"policy": {"departures": []}}
        if not self._is_forked and (not orders or chance.random() < _NEW_SEEDS):
            return {"seed": chance.randrange(1 << 32), "policy": {"departures": []}}
        overlay, order = orders[max(chance.randrange(len(orders)), chance.randrange(len(orders)))]
        place = chance.randrange(self._first, len(order))
        taken, count = order[place]
        other = chance.randrange(count - 1)
        run = other + (other >= taken)
        found = [(choice, one) for choice, (one, _) in enumerate(order[:place]) if one]
        departures = [*found, (place, run)] if run else found
        written = [{"choice": choice, "run": one} for choice, one in departures]
        return {**overlay, "policy": {"departures": written}}

    def learn(self, result: TrialResult) -> TrialResult | None:
        return self._keep(result)

    def recall(self, result: TrialResult) -> None:
        self._is_new(result.trial.overlay)
        self._keep(result)

    def _keep(self, result: TrialResult) -> TrialResult | None:
        self._runs += 1
        new = [one for one in result.behaviours if one not in self._seen]
        if not new:
            return None
        self._seen.update(new)
        overlay = {key: value for key, value in result.trial.overlay.items() if key != "policy"}
        self._orders.append((overlay, result.order))
        if len(self._orders) > _ORDERS_MAX:
            del self._orders[0]
        self._new_runs += 1
        return replace(result, behaviours=tuple(new))

    def coverage(self) -> list[str]:
        return [
            f"feedback: {self._new_runs} of {self._runs} runs showed something new, "
            f"{len(self._seen)} behaviours in all"
        ]
