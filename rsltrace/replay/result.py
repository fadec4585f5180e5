"""The result of a replay."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rsltrace.trace.model.texts import format_seconds

if TYPE_CHECKING:
    from rsltrace.diff.result import Diff
    from rsltrace.errors import RunError


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """How far a run did, event by event, what the trace ``trace`` (a path) says.

    ``verified`` is how many events, counted from 0, are the same in every hashed field; the trace
    has ``events``. ``digest`` is the chain hash of the last of these, 16 hex digits (zeros: none),
    ``end_ns`` its simulated time in nanoseconds, ``start_ns`` that of the start. ``ended`` says in
    words why the replay ended there. ``is_whole`` is true if that is the end of the trace's run;
    otherwise it diverged, ``until`` was reached, the trace was cut off or one of the runs was
    ended from outside.

    ``diff`` is None unless the run diverged; then it compares the trace (a) with the replay (b),
    which ends with the event that differs, number ``verified``. ``path`` is the replay's own trace,
    None if none was asked for. ``error`` is what went wrong in the run, which is no divergence if
    it did in the recorded run, too. ``notes`` are texts for people.

    With ``edits``, the run was verified up to the first of them and went on as a branch: ``digest``
    and ``end_ns`` are the branch's, and ``diff`` compares all of it with the trace, None if the
    edits have changed nothing.
    """

    trace: str
    verified: int
    events: int
    digest: str
    start_ns: int
    end_ns: int
    ended: str
    is_whole: bool
    path: Path | None = None
    diff: Diff | None = None
    error: RunError | None = field(default=None, compare=False)
    notes: tuple[str, ...] = ()
    interrupted: int = 0
    """The exit status of a replay that was itself interrupted (130: Ctrl-C), else 0."""
    edits: tuple[str, ...] = ()

    @property
    def sim_seconds(self) -> str:
        """Simulated duration in seconds, with nine decimals."""
        return format_seconds(self.end_ns - self.start_ns)

    @property
    def diverged(self) -> bool:
        """Whether the run did something else than the trace says (of a branch: because of it)."""
        return self.diff is not None

    @property
    def exit_code(self) -> int:
        """0 verified as far as it went, 1 diverged; of an interrupted replay 130, 143 or 129."""
        return 1 if self.diverged else self.interrupted

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        if self.edits:
            if self.diff is None:
                return f"the edits change nothing: the branch has the digest {self.digest}, too"
            return f"a branch from event {self.verified} on: {self.diff.sentence}"
        if self.diff is not None:
            how_far = f"the first {self.verified} events of {self.events} agree"
            return f"diverged at event {self.verified} ({how_far}): {self.diff.sentence}"
        of = "all" if self.verified == self.events else "the first"
        count = f"{of} {self.verified} events"
        if self.verified != self.events:
            count += f" of {self.events}"
        return f"verified {count}, to {self.sim_seconds} s ({self.ended})"
