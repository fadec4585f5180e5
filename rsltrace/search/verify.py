"""Run a job many times under perturbed environments and compare the digests."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from rsltrace.child_processes import Processes
from rsltrace.search.perturb import KINDS, Recorded, Surroundings, record_in, surroundings

_TIMEOUT_MIN_S = 120.0
_TIMEOUT_FACTOR = 30
_NARROWING_S = 120.0
"""Each perturbation is tried alone only if that takes no longer than this."""

OnRun = Callable[[Recorded], None]


@dataclass(frozen=True, slots=True)
class Verified:
    """The runs and their result.

    ``other`` is the first run (by number) that differs from ``first``. ``provoked_by`` are its
    perturbations that make a difference alone; ``narrowed`` says whether that was tried.
    ``by_itself``: a second unperturbed run differs, too. ``trouble`` is a run that did not finish.
    """

    first: Recorded
    runs: int
    kinds: tuple[str, ...]
    digests: tuple[str, ...]
    other: Recorded | None = None
    trouble: Recorded | None = None
    narrowed: bool = False
    provoked_by: tuple[str, ...] = ()
    by_itself: bool = False

    @property
    def agrees(self) -> bool:
        """Whether all runs finished with the same result."""
        return self.other is None and self.trouble is None


class Verification:
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

    def verify(self, runs: int, on_run: OnRun = lambda recorded: None) -> Verified:
        """Record ``runs`` times, until two runs differ or one does not finish."""
        begin = time.monotonic()
        with self._ending():
            first = self._record(surroundings(0))
            on_run(first)
            took_s = time.monotonic() - begin
            if first.failure:
                return Verified(first, 1, (), (first.digest,), trouble=first)
            if self._timeout_s is None:
                self._timeout_s = max(_TIMEOUT_MIN_S, _TIMEOUT_FACTOR * took_s)
            done = [first, *self._others(first, runs, on_run)]
            differing = [one for one in done if one.outcome != first.outcome]
            ended = [one for one in differing if one.digest]
            kinds = {kind for one in done for kind in one.surroundings.values}
            tried = Verified(
                first,
                len(done),
                tuple(kind for kind in KINDS if kind in kinds),
                tuple(sorted({one.digest for one in done if one.digest})),
            )
            if not differing:
                return tried
            if not ended:
                return replace(tried, trouble=differing[0])
            return self._narrowed(replace(tried, other=ended[0]), took_s)

    @contextmanager
    def _ending(self) -> Iterator[None]:
        try:
            yield
        finally:
            self._processes.kill()

    def _record(self, around: Surroundings) -> Recorded:
        return record_in(
            around,
            self._arguments,
            self._folder,
            processes=self._processes,
            timeout_s=self._timeout_s,
        )

    def _others(self, first: Recorded, runs: int, on_run: OnRun) -> list[Recorded]:
        """Return the other runs by number; no new ones begin after a difference."""
        differs = threading.Event()

        def next_one(around: Surroundings) -> Recorded | None:
            if differs.is_set():
                return None
            recorded = self._record(around)
            if recorded.outcome != first.outcome:
                differs.set()
            return recorded

        done = []
        with self._pool() as pool:
            waiting = [
                pool.submit(next_one, surroundings(number, self._seed)) for number in range(1, runs)
            ]
            for future in as_completed(waiting):
                recorded = future.result()
                if recorded is None:
                    continue
                done.append(recorded)
                on_run(recorded)
                if recorded.outcome == first.outcome:
                    self._forget(recorded)
        return sorted(done, key=lambda one: one.surroundings.number)

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

    def _forget(self, recorded: Recorded) -> None:
        if not self._keep:
            recorded.path.unlink(missing_ok=True)

    def _narrowed(self, found: Verified, took_s: float) -> Verified:
        """Try a second unperturbed run, then each perturbation alone."""
        first, other = found.first, found.other
        assert other is not None
        again = self._record(Surroundings(0, {}, "again"))
        if again.outcome != first.outcome:
            self._forget(again)
            return replace(found, narrowed=True, by_itself=True)
        self._forget(again)
        kinds = list(other.surroundings.values)
        if took_s * len(kinds) > _NARROWING_S * self._workers:
            return found
        with self._pool() as pool:
            runs = list(pool.map(self._record, map(other.surroundings.only, kinds)))
        provoked = tuple(
            kind for kind, run in zip(kinds, runs, strict=True) if run.outcome != first.outcome
        )
        for run in runs:
            self._forget(run)
        return replace(found, narrowed=True, provoked_by=provoked)
