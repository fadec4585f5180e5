"""When a run ends. Conditions are asked only between time steps: the last step runs fully."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from rsltrace.fast_dataclass import dataclass


@dataclass(frozen=True, slots=True)
class Stop:
    """Why a run ended, in words for a person, and the exit status that follows from it."""

    reason: str
    exit_code: int = 0


class Progress(NamedTuple):
    """What a stop condition may look at: times in ns, and counts since the start of the run.

    ``activity_ns`` is the last time at which anything was published, called or answered.
    """

    now_ns: int
    next_ns: int | None
    start_ns: int
    events: int
    activity_ns: int


class StopCondition(Protocol):
    """Asked after each time step; ``progress.next_ns`` is when the next one would be."""

    def __call__(self, progress: Progress) -> Stop | None:
        """Return why to stop now, or None to go on."""


class _StopAt:
    """See ``stop_at``. ``quiet_until_ns``: no answer while time is before, and stays up to it."""

    def __init__(self, time_ns: int, stop: Stop) -> None:
        self.quiet_until_ns = time_ns
        self._stop = stop

    def __call__(self, progress: Progress) -> Stop | None:
        now_ns, next_ns, time_ns = progress.now_ns, progress.next_ns, self.quiet_until_ns
        if next_ns is None:
            over = now_ns >= time_ns
        else:  # what is due now is of a step that is not over
            over = max(now_ns, next_ns) > time_ns
        return self._stop if over else None


def stop_at(time_ns: int, reason: str, exit_code: int = 0) -> StopCondition:
    """Run every step up to and including ``time_ns``."""
    return _StopAt(time_ns, Stop(reason, exit_code))


def quiet_until_ns(conditions: tuple[StopCondition, ...]) -> int:
    """Return the time before which none of the conditions needs to be asked; 2**63, where time
    ends, is the latest."""
    return min([2**63, *(getattr(c, "quiet_until_ns", -1) for c in conditions)])


def stop_after_events(count: int) -> StopCondition:
    """Stop after the step in which the number of events reaches ``count``."""

    def condition(progress: Progress) -> Stop | None:
        return Stop(f"{count} events") if progress.events >= count else None

    return condition
