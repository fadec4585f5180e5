"""A search: run what a strategy proposes and write it down, until the budget is used up."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from rsltrace.job import Job
from rsltrace.search.explore.outcome import TrialOptions
from rsltrace.search.explore.strategies.strategy import Strategy
from rsltrace.search.explore.table import ResultsFolder
from rsltrace.search.explore.trial import KeptTraces, Trial, TrialResult
from rsltrace.trace.mcap.sink import unfinished_path

_TIMEOUT_MIN_S = 60.0
_TIMEOUT_FACTOR = 30


@dataclass(frozen=True, slots=True)
class SearchBudget:
    """Limits of a search: trials, or seconds of real time (None: no limit)."""

    trials: int | None = None
    seconds: float | None = None


class TrialPool(Protocol):
    """Where trials run: ``workers.Workers``, or a cluster."""

    @property
    def idle(self) -> int:
        """How many more trials can be begun."""

    @property
    def busy(self) -> int:
        """How many trials are under way."""

    def submit(
        self, trial: Trial, trace: Path, wants: TrialOptions, timeout_s: float | None = None
    ) -> None:
        """Begin a trial."""

    def results(self, wait_s: float | None = None) -> Iterator[TrialResult]:
        """Wait for results, ``wait_s`` at most, and yield them."""


@dataclass
class SearchTally:
    """The results of a search so far, without anything that grows with each run."""

    runs: int = 0
    events: int = 0
    digests: set[int] = field(default_factory=set)
    failures: Counter[str] = field(default_factory=Counter)
    """How many runs failed, by cause (``Failure.key``)."""
    first: dict[str, TrialResult] = field(default_factory=dict)
    """The first run of each cause."""
    plain: TrialResult | None = None
    forked: int = 0
    """How many runs were forked from their common prefix."""
    not_forked: Counter[str] = field(default_factory=Counter)
    """How many should have been, by the reason why they were not."""

    def add(self, result: TrialResult) -> None:
        """Count a run."""
        self.runs += 1
        self.events += result.events
        self.forked += result.is_forked
        if result.why_not_forked:
            self.not_forked[result.why_not_forked] += 1
        if result.digest:
            self.digests.add(int(result.digest, 16))
        if result.failure is not None:
            key = result.failure.key
            self.failures[key] += 1
            first = self.first.get(key)
            if first is None or result.trial.number < first.trial.number:
                self.first[key] = result


class Explorer:
    """One search; a context manager, around that of its pool.

    ``run`` returns when the budget is used up, nothing is left to try, or ``stop`` is called.
    """

    def __init__(
        self,
        job: Job,
        strategy: Strategy,
        table: ResultsFolder,
        *,
        budget: SearchBudget,
        stop_at_first: bool = False,
        timeout_s: float | None = None,
        fork_ns: int = -1,
    ) -> None:
        """``fork_ns``: the simulated time after which runs may be forked from the plain one."""
        self.tally = SearchTally()
        self.strategy = strategy
        self.began_s = time.monotonic()
        self.runs_here = 0
        """How many runs have ended since ``began_s``, without those of a resumed search."""
        self.failed_here = 0
        """How many of them failed."""
        self.has_run_plain = False
        """Whether the plain run is one of them."""
        self.is_exhausted = False
        """Whether the strategy has nothing left to try."""
        self._table = table
        self._kept = KeptTraces()
        self._plain = _plain_trial(job)
        self._budget = budget
        self._stop_at_first = stop_at_first
        self._timeout_s = timeout_s
        self._fork_ns = fork_ns
        self._stopped = False
        self._done: set[int] = set()
        self._under_way: set[int] = set()
        self._number = 1

    def __enter__(self) -> Explorer:
        return self

    def __exit__(self, *_: object) -> None:
        self._delete_unfinished()

    def _delete_unfinished(self) -> None:
        """Delete the traces of runs that ended with the pool and have no row."""
        for number in self._under_way:
            path = self._table.trace_of(number)
            for one in (path, unfinished_path(path)):
                one.unlink(missing_ok=True)

    def stop(self) -> None:
        """Begin no more trials."""
        self._stopped = True

    def run(
        self, pool: TrialPool, on_result: Callable[[TrialResult], None] = lambda one: None
    ) -> None:
        """Search; ``on_result`` receives each run that has ended.

        :raises ExploreError: a run cannot start, or a result cannot be written.
        """
        self.began_s = time.monotonic()
        try:
            if self._recall() is None:
                self._run_plain(pool, on_result)
            self._go_on(pool, on_result)
        finally:
            self._delete_unfinished()

    def _go_on(self, pool: TrialPool, on_result: Callable[[TrialResult], None]) -> None:
        while True:
            while pool.idle and self._may_begin(pool):
                trial = self._next()
                if trial is None:
                    break
                self._submit(pool, trial, self._wants())
            if not pool.busy:
                self.is_exhausted = self._may_begin(pool)
                return
            for result in pool.results(self._left_s()):
                self._take(result, on_result)
            if self._left_s() == 0:
                return  # runs under way may take long: do not wait for them

    def _recall(self) -> TrialResult | None:
        """Load the existing results; return that of the plain run, if it is there."""
        learned = {one.trial.number: one for one in self._table.learned}
        plain = None
        for row in self._table.earlier:
            self._count(row)
            self._done.add(row.trial.number)
            full = learned.get(row.trial.number, row)
            if row.trial.number == 0:
                plain = full
        if plain is not None:
            self._begin(plain)
            for row in self._table.earlier:
                if row.trial.number:
                    self.strategy.recall(learned.get(row.trial.number, row))
        return plain

    def _run_plain(self, pool: TrialPool, on_result: Callable[[TrialResult], None]) -> None:
        """Run the job as it is."""
        self.has_run_plain = True
        wants = replace(self._wants(), keep=True, strict=True)
        self._submit(pool, self._plain, wants)
        found: list[TrialResult] = []
        while not found:
            found = list(pool.results())
        self._begin(found[0])
        self._keep(found[0], found[0], on_result)

    def _submit(self, pool: TrialPool, trial: Trial, wants: TrialOptions) -> None:
        self._under_way.add(trial.number)
        pool.submit(trial, self._table.trace_of(trial.number), wants, self._timeout_s)

    def _begin(self, plain: TrialResult) -> None:
        self.tally.plain = plain
        if self._timeout_s is None:
            self._timeout_s = max(_TIMEOUT_MIN_S, _TIMEOUT_FACTOR * plain.wall_s)
        self.strategy.begin(plain)

    def _may_begin(self, pool: TrialPool) -> bool:
        if self._stopped or self._left_s() == 0:
            return False
        if self._stop_at_first and self.tally.failures:
            return False
        most = self._budget.trials
        return most is None or self.tally.runs + pool.busy < most

    def _left_s(self) -> float | None:
        if self._budget.seconds is None:
            return None
        return max(self._budget.seconds - (time.monotonic() - self.began_s), 0)

    def _next(self) -> Trial | None:
        """Return the next trial, with the first free number."""
        while self._number in self._done:
            self._number += 1
        proposal = self.strategy.propose(self._number)
        if proposal is None:
            return None
        self._done.add(self._number)
        return Trial(self._number, proposal.overlay, proposal.why)

    def _wants(self) -> TrialOptions:
        strategy = self.strategy
        return TrialOptions(
            behaviours=strategy.behaviours, steps=strategy.steps, fork_ns=self._fork_ns
        )

    def _take(self, result: TrialResult, on_result: Callable[[TrialResult], None]) -> None:
        self._keep(result, self.strategy.learn(result), on_result)

    def _keep(
        self,
        result: TrialResult,
        learned: TrialResult | None,
        on_result: Callable[[TrialResult], None],
    ) -> None:
        """Count a run and write it down."""
        self._under_way.discard(result.trial.number)
        self.runs_here += 1
        self.failed_here += result.failure is not None
        result = self._count(replace(result, behaviours=(), order=(), steps=()))
        self._table.add(result, learned)
        on_result(result)

    def _count(self, result: TrialResult) -> TrialResult:
        """Count a run; return its row, without a trace that is not kept."""
        self.tally.add(result)
        if result.failure is None:
            return result
        number = result.trial.number
        dropped = self._kept.add(result.failure.key, number)
        if dropped is not None:
            with suppress(OSError):
                self._table.trace_of(dropped).unlink()
        return replace(result, trace=None) if dropped == number else result


def _plain_trial(job: Job) -> Trial:
    """Return the trial of a job as it is. If it has no policy, choices are counted."""
    is_plain = job.policy is None or job.policy.is_plain
    overlay: dict[str, Any] = {"policy": {"departures": []}} if is_plain else {}
    return Trial(0, overlay, "the job as it is")
