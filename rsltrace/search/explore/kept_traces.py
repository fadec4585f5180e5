"""Which traces of runs that failed are kept: the choice does not depend on who is faster.

Rejected: the traces that come first. Several runs are under way at a time, so the trace of the
first trial of a cause, which is made small, could come when there were enough.
"""

from __future__ import annotations

from bisect import bisect_left

_KEPT_OF_A_CAUSE = 3


class KeptTraces:
    """Keeps, of each cause of failures, the traces of the trials with the lowest numbers."""

    def __init__(self) -> None:
        self._numbers: dict[str, list[int]] = {}

    def add(self, cause: str, number: int) -> int | None:
        """Take note of a trial that failed; return the trial whose trace is not kept (any more):
        this one, an earlier one that it displaces, or None."""
        kept = self._numbers.setdefault(cause, [])
        place = bisect_left(kept, number)
        if kept[place : place + 1] != [number]:
            kept.insert(place, number)
        return kept.pop() if len(kept) > _KEPT_OF_A_CAUSE else None
