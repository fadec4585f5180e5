"""The interface of a strategy: it proposes trials, and learns from their results."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

from rsltrace.errors import ExploreError
from rsltrace.search.explore.trial import TrialResult


class Proposal(NamedTuple):
    """A trial without a number: its overlay, and a description for people."""

    overlay: Mapping[str, Any]
    why: str


class Strategy(ABC):
    """Chooses what to try. It must be deterministic, so that a search can be resumed and repeated;
    several of its trials may be under way at a time.

    ``behaviours`` and ``steps`` say what it needs of results (``TrialResult``).
    """

    behaviours = False
    steps = False

    @abstractmethod
    def begin(self, plain: TrialResult) -> None:
        """Look at the run of the job as it is, before the first proposal."""

    @abstractmethod
    def propose(self, number: int) -> Proposal | None:
        """Return trial ``number``; None if there is nothing to try until more results come."""

    def learn(self, result: TrialResult) -> TrialResult | None:
        """Learn from the result of a trial; return what ``recall`` needs, None if its row is
        enough."""
        return None

    @abstractmethod
    def recall(self, result: TrialResult) -> None:
        """Learn from a result of a resumed search: what ``learn`` returned, or the row. Called
        after ``begin``, for all results in their order."""

    @abstractmethod
    def coverage(self) -> list[str]:
        """Return sentences for people on what was tried."""


def choices_left(plain: TrialResult, *, is_forked: bool = False) -> int:
    """Return how many choices of the plain run may be changed.

    :raises ExploreError: there are none after the time at which runs are forked.
    """
    if plain.choices == plain.choices_before and (plain.choices or is_forked):
        failed = "" if plain.failure is None else f" ({plain.failure.text.splitlines()[0]})"
        raise ExploreError(
            f"--fork-after: the plain run{failed} has no choice of what runs next after that time; "
            "give an earlier one, or --set min_time_step=5ms to choose among what is due within 5 "
            "ms"
        )
    return plain.choices - plain.choices_before
