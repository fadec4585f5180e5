"""When a run ends. Conditions are asked only between time steps: the last step runs fully."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from rsltrace.errors import RunError


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
    """Return the time before which none of the conditions needs to be asked."""
    never_asked = 2**63
    return min((getattr(c, "quiet_until_ns", -1) for c in conditions), default=never_asked)


def stop_after_events(count: int) -> StopCondition:
    """Stop after the step in which the number of events reaches ``count``."""

    def condition(progress: Progress) -> Stop | None:
        return Stop(f"{count} events") if progress.events >= count else None

    return condition


def stop_when_quiet(duration_ns: int, reason: str) -> StopCondition:
    """Stop once nothing was published, called or answered for ``duration_ns``."""

    def condition(progress: Progress) -> Stop | None:
        quiet_since = max(progress.activity_ns, progress.start_ns)
        next_ns = progress.now_ns if progress.next_ns is None else progress.next_ns
        return Stop(reason) if next_ns - quiet_since > duration_ns else None

    return condition


def stop_when(function: Callable[[Progress], object], name: str) -> StopCondition:
    """Stop when a user's function says so.

    ``True`` stops with exit status 0, an integer other than a bool stops with that exit status,
    ``None`` and ``False`` go on; so the integer 0 stops with status 0, too.

    :raises RunError: if the function raises, or returns anything else.
    """

    def condition(progress: Progress) -> Stop | None:
        try:
            answer = function(progress)
        except SystemExit as error:
            answer = 0 if error.code is None else error.code
            if not isinstance(answer, int):
                return Stop(f"function {name} raised SystemExit: {answer}", 1)
        except Exception as error:
            raise RunError(
                f"the stop function {name} raised {type(error).__qualname__}: {error}"
            ) from error
        else:
            if answer is None or answer is False:
                return None
        code = 0 if answer is True else answer
        if not isinstance(code, int):
            raise RunError(
                f"the stop function {name} returned {answer!r}; "
                "expected None, a bool or an integer exit status"
            )
        return Stop(f"function {name}", code)

    return condition
