"""The strategies by the names that a command line gives them."""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.errors import ExploreError
from rsltrace.job import Job, locate
from rsltrace.run.plans.scheduling import switches_at_lines
from rsltrace.search.explore.strategies.faults import FaultWalk
from rsltrace.search.explore.strategies.feedback import Feedback
from rsltrace.search.explore.strategies.strategy import Proposal, Strategy
from rsltrace.search.explore.strategies.systematic import Systematic
from rsltrace.search.explore.strategies.vary import VaryWalk
from rsltrace.search.explore.strategies.walks import PctWalk, RandomWalk
from rsltrace.search.explore.trial import TrialResult

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
    return Mixed([pct, Feedback(seed, is_forked=after is not None), RandomWalk(seed, after)])


def _check_forks(name: str, job: Job) -> None:
    if name == "vary":
        raise ExploreError(
            "--fork-after: runs with other settings differ from their beginning; leave it out"
        )
    if name != "faults" and job.policy is not None and job.policy.order != "fifo":
        raise ExploreError(
            f"--fork-after: {locate(job, ('policy',))}: up to that time the order has to be the "
            "plain one; leave the policy out of the job, or --fork-after"
        )


class Mixed:
    """Several strategies in turn. Those whose trials follow from their numbers, or that always have
    something to propose."""

    steps = False

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
