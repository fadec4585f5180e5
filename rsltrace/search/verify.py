"""Run a job many times under perturbed environments and compare the digests."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from rsltrace.child_processes import Processes
from rsltrace.search.perturb import (
    KINDS,
    Perturbation,
    PerturbedRun,
    perturbation,
    record_perturbed,
)

_TIMEOUT_MIN_S = 120.0
_TIMEOUT_FACTOR = 30
_NARROWING_S = 120.0
"""Each perturbation is tried alone only if that takes no longer than this."""

OnRun = Callable[[PerturbedRun], None]


@dataclass(frozen=True, slots=True)
class HiddenDifference:
    """Two runs of equal events that left the state of a ``node`` different.

    ``attribute`` is one of the node's that differs in the first sample that does, taken after
    ``event`` of ``run``. ``traces`` are of two more such runs, with the states after all
    events; None if these two happened to be the same.
    """

    node: str
    attribute: str
    event: int
    run: PerturbedRun
    traces: tuple[PerturbedRun, PerturbedRun] | None


@dataclass(frozen=True, slots=True)
class VerifyResult:
    """The runs and their result.

    ``other`` is the first run (by number) that differs from ``first``. ``provoked_by`` are its
    perturbations that make a difference alone; ``narrowed`` says whether that was tried.
    ``by_itself``: a second unperturbed run differs, too. ``hidden`` is of runs whose events agree.
    ``trouble`` is a run that did not finish.
    """

    first: PerturbedRun
    runs: int
    kinds: tuple[str, ...]
    digests: tuple[str, ...]
    other: PerturbedRun | None = None
    trouble: PerturbedRun | None = None
    narrowed: bool = False
    provoked_by: tuple[str, ...] = ()
    by_itself: bool = False
    hidden: HiddenDifference | None = None

    @property
    def agrees(self) -> bool:
        """Whether all runs finished with the same result."""
        return self.other is None and self.trouble is None


class DeterminismTest:
    """Runs one job many times. ``arguments`` are those of ``rsltrace record``, paths absolute.

    Traces go to ``folder``; those equal to the first one are deleted unless ``keep``.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        folder: Path,
        *,
        workers: int = 1,
        seed: int = 0,
        timeout_s: float | None = None,
        keep: bool = False,
    ) -> None:
        self._arguments = tuple(arguments)
        self._folder = folder
        self._workers = workers
        self._seed = seed
        self._timeout_s = timeout_s
        self._keep = keep
        self._processes = Processes()

    def verify(self, runs: int, on_run: OnRun = lambda recorded: None) -> VerifyResult:
        """Record ``runs`` times, until two runs differ or one does not finish."""
        begin = time.monotonic()
        with self._processes:
            first = self._record(perturbation(0))
            on_run(first)
            took_s = time.monotonic() - begin
            if first.failure:
                return VerifyResult(first, 1, (), (first.digest,), trouble=first)
            if self._timeout_s is None:
                self._timeout_s = max(_TIMEOUT_MIN_S, _TIMEOUT_FACTOR * took_s)
            done = [first, *self._others(first, runs, on_run)]
            differing = [one for one in done if one.outcome != first.outcome]
            ended = [one for one in differing if one.digest]
            kinds = {kind for one in done for kind in one.perturbation.values}
            tried = VerifyResult(
                first,
                len(done),
                tuple(kind for kind in KINDS if kind in kinds),
                tuple(sorted({one.digest for one in done if one.digest})),
            )
            if not differing:
                other = next((one for one in done if one.states != first.states), None)
                return tried if other is None else self._hidden(tried, other, took_s)
            if not ended:
                return replace(tried, trouble=differing[0])
            return self._narrowed(replace(tried, other=ended[0]), took_s)

    def _hidden(self, tried: VerifyResult, other: PerturbedRun, took_s: float) -> VerifyResult:
        """Find what provokes it that states differ, and where: the two runs are made again with
        the states after all events in their traces."""
        first = tried.first
        narrowed = self._narrowed(replace(tried, other=other), took_s)
        event, node, attribute = _first_sample(first.states, other.states)
        around = other.perturbation
        if narrowed.by_itself:
            around = Perturbation(0, {}, "again")
        elif narrowed.provoked_by:
            around = around.only(narrowed.provoked_by[0])
        one, two = (
            record_perturbed(
                perturbed,
                (*self._arguments, "--set", "guard.state=record"),
                self._folder,
                path=self._folder / f"states-{name}.mcap",
                processes=self._processes,
                timeout_s=self._timeout_s,
            )
            for name, perturbed in (("a", first.perturbation), ("b", around))
        )
        differ = one.digest and two.digest and one.digest != two.digest
        hidden = HiddenDifference(node, attribute, event, other, (one, two) if differ else None)
        return replace(narrowed, other=None, hidden=hidden)

    def _record(self, around: Perturbation) -> PerturbedRun:
        return record_perturbed(
            around,
            self._arguments,
            self._folder,
            processes=self._processes,
            timeout_s=self._timeout_s,
        )

    def _others(self, first: PerturbedRun, runs: int, on_run: OnRun) -> list[PerturbedRun]:
        """Return the other runs by number; no new ones begin after a difference."""
        differs = threading.Event()

        def next_one(around: Perturbation) -> PerturbedRun | None:
            if differs.is_set():
                return None
            recorded = self._record(around)
            if recorded.outcome != first.outcome:
                differs.set()
            return recorded

        done = []
        with self._pool() as pool:
            waiting = [
                pool.submit(next_one, perturbation(number, self._seed)) for number in range(1, runs)
            ]
            for future in as_completed(waiting):
                recorded = future.result()
                if recorded is None:
                    continue
                done.append(recorded)
                on_run(recorded)
                if recorded.outcome == first.outcome:
                    self._forget(recorded)
        return sorted(done, key=lambda one: one.perturbation.number)

    @contextmanager
    def _pool(self) -> Iterator[ThreadPoolExecutor]:
        pool = ThreadPoolExecutor(max_workers=self._workers)
        try:
            yield pool
        except BaseException:
            self._processes.kill()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _forget(self, recorded: PerturbedRun) -> None:
        if not self._keep:
            recorded.path.unlink(missing_ok=True)

    def _narrowed(self, found: VerifyResult, took_s: float) -> VerifyResult:
        """Try a second unperturbed run, then each perturbation alone."""
        first, other = found.first, found.other
        assert other is not None
        of_events = other.outcome != first.outcome

        def differs(run: PerturbedRun) -> bool:
            return run.outcome != first.outcome if of_events else run.kept != first.kept

        again = self._record(Perturbation(0, {}, "again"))
        if differs(again):
            self._forget(again)
            return replace(found, narrowed=True, by_itself=True)
        self._forget(again)
        kinds = list(other.perturbation.values)
        if took_s * len(kinds) > _NARROWING_S * self._workers:
            return found
        with self._pool() as pool:
            runs = list(pool.map(self._record, map(other.perturbation.only, kinds)))
        provoked = tuple(kind for kind, run in zip(kinds, runs, strict=True) if differs(run))
        for run in runs:
            self._forget(run)
        return replace(found, narrowed=True, provoked_by=provoked)


def _first_sample(one: str, other: str) -> tuple[int, str, str]:
    """Return event, node and attribute of the first sample that differs."""
    samples, others = json.loads(one), json.loads(other)
    found = [
        (event, node, name)
        for node, taken in samples.items()
        for (event, hashes), (_, more) in zip(taken, others.get(node, ()), strict=False)
        for name in sorted({*hashes, *more})
        if hashes.get(name) != more.get(name)
    ]
    return min(found, default=(0, "", ""))
