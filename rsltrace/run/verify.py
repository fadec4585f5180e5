"""Recording a job many times in unlike surroundings: is there one digest, and if not, why?"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path

from rsltrace.errors import SetupError
from rsltrace.run.perturb import KINDS, Recorded, Surroundings, record_in, surroundings


@dataclass(frozen=True, slots=True)
class Verified:
    """What was tried and what came of it.

    ``other`` is the first run that did something else than ``first``; ``provoked_by`` are the
    perturbations of it that make a difference on their own (empty: only several together, or the
    job differs from run to run by itself, which ``by_itself`` says).
    """

    first: Recorded
    runs: int
    kinds: tuple[str, ...]
    other: Recorded | None = None
    provoked_by: tuple[str, ...] = ()
    by_itself: bool = False
    digests: frozenset[str] = field(default=frozenset())

    @property
    def agrees(self) -> bool:
        """Whether every run did the same."""
        return self.other is None


def verify(
    job: Path,
    folder: Path,
    *,
    runs: int,
    workers: int = 1,
    seed: int = 0,
    arguments: Iterable[str] = (),
    on_run: Callable[[Recorded], None] = lambda recorded: None,
) -> Verified:
    """Record ``job`` ``runs`` times, each time in other surroundings, until two runs differ.

    ``folder`` takes the traces. A run that cannot even start is no answer.

    :raises SetupError: with what the command said, if the job cannot be run.
    """
    given = tuple(arguments)
    first = record_in(surroundings(0), job, folder, given)
    if not first.digest:
        raise SetupError(f"the job cannot be recorded:\n{first.errors.strip()}")
    on_run(first)
    tried, kinds, other = 1, set[str](), None
    digests = {first.digest}
    with ThreadPoolExecutor(max_workers=workers) as pool:
        waiting = [
            pool.submit(record_in, surroundings(number, seed), job, folder, given)
            for number in range(1, runs)
        ]
        for future in as_completed(waiting):
            if future.cancelled():
                continue
            recorded = future.result()
            if other is not None:
                continue
            tried += 1
            kinds.update(recorded.surroundings.values)
            digests.add(recorded.digest)
            on_run(recorded)
            if _differ(first, recorded):
                other = recorded
                for left in waiting:
                    left.cancel()
            else:
                recorded.path.unlink(missing_ok=True)
    ordered = tuple(kind for kind in KINDS if kind in kinds)
    if other is None:
        return Verified(first, tried, ordered, digests=frozenset(digests))
    again = record_in(Surroundings(-1, {}), job, folder, given)
    by_itself = _differ(first, again)
    provoked = () if by_itself else _provoked(first, other, job, folder, given)
    return Verified(first, tried, ordered, other, provoked, by_itself, frozenset(digests))


def _provoked(
    first: Recorded, other: Recorded, job: Path, folder: Path, arguments: tuple[str, ...]
) -> tuple[str, ...]:
    found = []
    for kind in other.surroundings.values:
        alone = record_in(other.surroundings.only(kind), job, folder, arguments)
        if _differ(first, alone):
            found.append(kind)
        alone.path.unlink(missing_ok=True)
    return tuple(found)


def _differ(a: Recorded, b: Recorded) -> bool:
    return (a.digest, a.exit_code) != (b.digest, b.exit_code)
