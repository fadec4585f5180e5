"""The interface of a strategy: it proposes trials, and is told what came of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from rsltrace.errors import ExploreError
from rsltrace.search.explore.trial import TrialResult


class Proposal(NamedTuple):
    """A trial without a number: what sets it apart, and what it is for people."""

    overlay: Mapping[str, Any]
    why: str


class Strategy(Protocol):
    """Says what to try. It has to do the same whenever it is told the same, so that a search can be
    resumed and repeated; several of its trials may be under way at a time.

    ``behaviours`` and ``steps`` say what it wants to know of runs (``TrialResult``).
    """

    behaviours: bool
    steps: bool

    def begin(self, plain: TrialResult) -> None:
        """Look at the run of the job as it is, before the first proposal."""

    def propose(self, number: int) -> Proposal | None:
        """Return what trial ``number`` should try; None: nothing (more) before it is told more."""

    def learn(self, result: TrialResult) -> TrialResult | None:
        """Look at the result of one of its trials; return what has to be kept of it for ``recall``,
        None if its number is enough."""

    def recall(self, result: TrialResult) -> None:
        """Look at a result of a search that is resumed: what ``learn`` returned of it, or its row.
        Comes after ``begin``, for all results, in the order in which they came."""

    def coverage(self) -> list[str]:
        """Say for people what was tried, and what that means."""


def choices_left(plain: TrialResult) -> int:
    """Return how many choices of the plain run other runs may make differently.

    :raises ExploreError: there are none after the time at which runs are forked.
    """
    if plain.choices and plain.choices == plain.choices_before:
        raise ExploreError(
            "--fork-after: the job as it is has no choice of what runs next after that time; give "
            "an earlier one"
        )
    return plain.choices - plain.choices_before
