"""How a run has gone so far: the error that ends it, and what is worth saying of it."""

from __future__ import annotations

from dataclasses import dataclass, field

from rsltrace.errors import RunError
from rsltrace.model.endless_wait import EndlessWait


@dataclass(slots=True)
class Outcome:
    """``ended_after`` is how many events there were when the run ended: what follows is the
    ending. ``waits`` are the calls that still waited then."""

    error: RunError | None = None
    notes: list[str] = field(default_factory=list)
    ended_after: int | None = None
    waits: list[EndlessWait] = field(default_factory=list)

    def note_end(self, events: int) -> None:
        """Remember how many events there were when the run ended; the first call counts."""
        if self.ended_after is None:
            self.ended_after = events
