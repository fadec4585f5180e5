"""How a run has gone so far: the error that ends it, and what is worth saying of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from rsltrace.errors import RunError
from rsltrace.trace.model.endless_wait import EndlessWait


@dataclass(slots=True)
class Outcome:
    """``ended_after`` is how many events there were when the run ended: what follows is the
    ending. ``waits`` are the calls that still waited then. ``drops`` count what full queues
    dropped, by receiver, and by how many messages a publisher holds if its queue was the full one
    (in an outage), else 0."""

    error: RunError | None = None
    notes: list[str] = field(default_factory=list)
    ended_after: int | None = None
    waits: list[EndlessWait] = field(default_factory=list)
    drops: dict[tuple[Any, int], int] = field(default_factory=dict)

    def note_end(self, events: int) -> None:
        """Remember how many events there were when the run ended; the first call counts."""
        if self.ended_after is None:
            self.ended_after = events
