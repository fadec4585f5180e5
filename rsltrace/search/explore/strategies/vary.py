"""Other settings: the combinations that ``vary:`` of the job describes."""

from __future__ import annotations

from rsltrace.errors import ExploreError
from rsltrace.job import Job
from rsltrace.search.explore.strategies.strategy import Proposal
from rsltrace.search.explore.trial import TrialResult
from rsltrace.search.explore.vary import Variations


class VaryWalk:
    """One combination of settings after the other; order and seed are the job's."""

    behaviours = False
    steps = False

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

    def learn(self, result: TrialResult) -> TrialResult | None:
        """Learn nothing."""
        return None

    def recall(self, result: TrialResult) -> None:
        self._tried += 1

    def coverage(self) -> list[str]:
        of = f" of {self._variations.count}" if self._variations.count is not None else ""
        return [
            f"settings ({self._method}): {self._tried}{of} combinations of {', '.join(self._names)}"
        ]
