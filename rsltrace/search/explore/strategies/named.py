"""The strategies by the names that a command line gives them."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from statistics import NormalDist
from typing import Any

from rsltrace.errors import ExploreError, JobError
from rsltrace.job import Job, locate
from rsltrace.job.dump import plain_part, plain_value
from rsltrace.job.parts.vary import SettingSpec, VarySpec
from rsltrace.run.plans.scheduling import switches_at_lines
from rsltrace.search.explore.strategies.faults import FaultWalk
from rsltrace.search.explore.strategies.strategy import Proposal, Strategy, choices_left
from rsltrace.search.explore.strategies.systematic import Systematic
from rsltrace.search.explore.trial import JobSource, Trial, TrialResult
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.simulation.loop.policy import pct_bound
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.texts import counted

# The settings of each run of a job with ``vary:``, by its number.


_SAMPLES = 100
_DIGITS = 9
_TAIL = 1e-12


class Variations:
    """The combinations of values of ``spec``; ``seed`` decides what is drawn. ``count`` is how many
    there are, None if they have no end."""

    def __init__(self, spec: VarySpec, seed: int = 0) -> None:
        self._spec = spec
        self._seed = seed
        self.count = spec.samples
        if spec.method == "grid":
            self.count = math.prod(map(len, self._axes.values()))
        elif spec.method == "latin_hypercube":
            self.count = spec.samples or _SAMPLES

    def at(self, number: int) -> dict[str, Any] | None:
        """Return the values of combination ``number`` (from 0) by the keys of the job, plain JSON;
        None after the last.

        :raises ExploreError: SciPy is needed, and not there.
        """
        if self.count is not None and number >= self.count:
            return None
        if self._spec.method == "grid":
            return self._of_grid(number)
        found = {}
        for place, (name, setting) in enumerate(self._spec.settings.items()):
            if self._spec.method == "random":
                share = RandomStream(self._seed, f"vary\0{name}\0{number}").uniform()
            else:
                share = float(self._shares[number][place])
            found[name] = _value(setting, share)
        return found

    def _of_grid(self, number: int) -> dict[str, Any]:
        """Return one combination; the last setting changes first."""
        found = {}
        for name, values in reversed(list(self._axes.items())):
            number, place = divmod(number, len(values))
            found[name] = values[place]
        return {name: found[name] for name in self._axes}

    @cached_property
    def _axes(self) -> Mapping[str, list[Any]]:
        return {name: _axis(setting) for name, setting in self._spec.settings.items()}

    @cached_property
    def _shares(self) -> Any:
        """A share of its range for each setting of each run, from 0 to 1."""
        try:
            import numpy as np
            from scipy.stats import qmc
        except ImportError:
            raise ExploreError(
                "method: latin_hypercube needs SciPy: pip install 'rsltrace[explore]'"
            ) from None
        generator = np.random.default_rng(self._seed)
        sampler = qmc.LatinHypercube(len(self._spec.settings), seed=generator)
        return sampler.random(self.count)


def check_vary(source: JobSource, job: Job) -> None:
    """Raise JobError, with its line, at a setting that the job cannot have."""
    if job.vary is None:
        raise ExploreError(f"{source.path} has no vary:, which says what to vary and between what")
    for name, setting in job.vary.settings.items():
        where = locate(job, ("vary", "settings", name))
        ends = _axis(setting) if setting.values else [_value(setting, 0.0), _value(setting, 1.0)]
        for value in ends:
            try:
                source.job(Trial(0, {"set": {name: value}}))
            except JobError as error:
                said = str(error)
                raise JobError(f"{name} cannot be {value}:\n{said}", where=where) from None


def _axis(setting: SettingSpec) -> list[Any]:
    """Return the values that a grid has of a setting."""
    if setting.values is not None:
        return [plain_value(value, plain_part) for value in setting.values]
    if setting.integers is not None:
        first, last = setting.bounds
        return list(range(int(first), int(last) + 1))
    steps = setting.steps or 2
    return [_value(setting, step / (steps - 1)) for step in range(steps)]


def _value(setting: SettingSpec, share: float) -> Any:
    """Return the value at a share (0 to 1) of what a setting may be."""
    if setting.values is not None:
        place = min(int(share * len(setting.values)), len(setting.values) - 1)
        return plain_value(setting.values[place], plain_part)
    first, second = setting.bounds
    if setting.integers is not None:
        return min(int(first) + int(share * (second - first + 1)), int(second))
    if setting.uniform is not None:
        found = first + share * (second - first)
    elif setting.log_uniform is not None:
        found = first * math.exp(share * math.log(second / first))
    else:
        found = NormalDist(first, second).inv_cdf(min(max(share, _TAIL), 1 - _TAIL))
    if setting.of_time:
        return f"{max(round(found), 0)}ns"
    return float(f"{found:.{_DIGITS}g}")  # what a person may type, and exactly what is used


# Orders near those that have shown something new: one more departure from one of them.

_TRIES = 20
_ORDERS_MAX = 2_000
_NEW_SEEDS = 0.2


class Feedback(Strategy):
    """Keeps the orders of runs in which something happened that had not happened before (an event
    with its content and its node's state, two events of a node in that order), and departs from
    one of them at one more choice; the newest are taken most often."""

    behaviours = True

    def __init__(self, seed: int = 0, *, is_forked: bool = False) -> None:
        """``is_forked``: runs begin as the plain one, with its seed."""
        self._seed = seed
        self._is_forked = is_forked
        self._first = 0
        self._seen: set[int] = set()
        self._orders: list[tuple[dict[str, Any], tuple[tuple[int, int], ...]]] = []
        """What else distinguishes a run (its seed, say), and of each choice which of how many."""
        self._tried: set[int] = set()
        self._runs = self._new_runs = 0

    def begin(self, plain: TrialResult) -> None:
        choices_left(plain, is_forked=self._is_forked)
        self._first = plain.choices_before
        self._keep(plain)

    def propose(self, number: int) -> Proposal | None:
        chance = random.Random(f"{self._seed} {number}")
        overlay: dict[str, Any] = {}
        for _ in range(_TRIES):
            overlay = self._near(chance)
            if self._is_new(overlay):
                break
        words = f"near what was new, {counted(len(overlay['policy']['departures']), 'departure')}"
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
            f"feedback: {self._new_runs} of {counted(self._runs, 'run')} showed something new, "
            f"{counted(len(self._seen), 'behaviour')} in all"
        ]


# Random orders: a walk that chooses among all that could run, and PCT with its guarantee.


class _ByNumber(Strategy):
    """A strategy whose trials follow from their numbers."""

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
        choices_left(plain, is_forked=self._after is not None)


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
        return [f"random walk: {counted(self._tried, 'seed')}"] if self._tried else []

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
        self._choices = max(choices_left(plain, is_forked=self._after is not None), 1)
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
                    f"({self._entities} {'entity' if self._entities == 1 else 'entities'}, "
                    f"{counted(self._choices, 'choice')})"
                )
        return lines


# Other settings: the combinations that ``vary:`` of the job describes.


class VaryWalk(Strategy):
    """One combination of settings after the other; order and seed are the job's."""

    def __init__(self, job: Job, seed: int = 0) -> None:
        if job.vary is None:
            raise ExploreError("the job has no vary:, which says what to vary and between what")
        self._names = tuple(job.vary.settings)
        self._method = job.vary.method.replace("_", " ")
        self._variations = Variations(job.vary, seed)
        self._tried = 0

    def begin(self, plain: TrialResult) -> None:
        """Need nothing of the plain run."""

    def propose(self, number: int) -> Proposal | None:
        values = self._variations.at(number - 1)
        if values is None:
            return None
        self._tried += 1
        why = ", ".join(f"{name} = {value}" for name, value in values.items())
        return Proposal({"set": values}, why)

    def recall(self, result: TrialResult) -> None:
        self._tried += 1

    def coverage(self) -> list[str]:
        of = f" of {self._variations.count}" if self._variations.count is not None else ""
        return [
            f"settings ({self._method}): {self._tried}{of} combinations of {', '.join(self._names)}"
        ]


NAMES = ("mixed", "pct", "random", "feedback", "systematic", "faults", "vary")


def strategy_named(
    name: str,
    job: Job,
    *,
    seed: int = 0,
    depth: int | None = None,
    fork_after: tuple[str, int] | None = None,
) -> Strategy:
    """Return a new strategy. ``depth`` is the depth of bugs that PCT looks for (up to 3), or how
    many departures from the plain order the systematic search makes (any number). ``fork_after``:
    its runs begin as the plain one up to this simulated time, given as a job has it, and in ns.

    :raises ExploreError: it cannot be applied to the job.
    """
    after, fork_ns = fork_after or (None, -1)
    if after is not None:
        _check_forks(name, job)
    if name == "systematic":
        if switches_at_lines(job):
            raise ExploreError(
                "the systematic search takes callbacks as whole, which threads: {switch: "
                "every_line} of the job divides: give --strategy pct, random, feedback or mixed, "
                "or search without that key"
            )
        return Systematic(depth)
    if name == "faults":
        return FaultWalk(job, seed, fork_ns=fork_ns)
    if name == "vary":
        return VaryWalk(job, seed)
    if name == "feedback":
        return Feedback(seed, is_forked=after is not None)
    if name == "random":
        return RandomWalk(seed, after)
    pct = PctWalk(depth or 3, seed, after)
    if name == "pct":
        return pct
    return MixedStrategy(
        [pct, Feedback(seed, is_forked=after is not None), RandomWalk(seed, after)]
    )


def _check_forks(name: str, job: Job) -> None:
    if name == "vary":
        raise ExploreError(
            "--fork-after: runs with other settings differ from their beginning; leave it out"
        )
    if name != "faults" and job.policy is not None and not job.policy.is_plain:
        raise ExploreError(
            f"--fork-after: {locate(job, ('policy',))}: up to that time the order has to be the "
            "plain one; leave the policy out of the job, or --fork-after"
        )


class MixedStrategy(Strategy):
    """Several strategies in turn. Those whose trials follow from their numbers, or that always have
    something to propose."""

    def __init__(self, strategies: Sequence[Strategy]) -> None:
        self._strategies = tuple(strategies)
        self.behaviours = any(one.behaviours for one in strategies)

    def begin(self, plain: TrialResult) -> None:
        for one in self._strategies:
            one.begin(plain)

    def propose(self, number: int) -> Proposal | None:
        turn, place = divmod(number, len(self._strategies))
        return self._strategies[place].propose(turn)

    def learn(self, result: TrialResult) -> TrialResult | None:
        # What is new in any run is near what else may be new.
        kept = (one.learn(result) for one in self._strategies)
        return next((one for one in list(kept) if one is not None), None)

    def recall(self, result: TrialResult) -> None:
        for one in self._strategies:
            one.recall(result)

    def coverage(self) -> list[str]:
        return [line for one in self._strategies for line in one.coverage()]
