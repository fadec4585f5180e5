"""Times as people type them: seconds, or a number with a unit as in a job."""

from __future__ import annotations

from typing import NamedTuple

_ENDS_OF_NUMBERS = tuple("0123456789.")


class TimeInRun(NamedTuple):
    """A time in a run: counted from its start, or (``is_absolute``) the simulated time itself."""

    time_ns: int
    is_absolute: bool = False

    def stamp_ns(self, start_ns: int) -> int:
        """Return the simulated time in a run that starts at ``start_ns``."""
        return self.time_ns if self.is_absolute else start_ns + self.time_ns


START = TimeInRun(0)


def parse_time_in_run(text: str) -> TimeInRun:
    """Return a time in a run: ``2.5``, ``2.5s`` and ``20ms`` count from its start, ``@2.5`` is the
    simulated time that events have. Raises ValueError."""
    text = text.strip()
    return TimeInRun(parse_stamp(text.removeprefix("@")), text.startswith("@"))


def parse_stamp(text: str) -> int:
    """Return a time such as ``1.5``, ``1.5s``, ``20ms`` in nanoseconds. Raises ValueError."""
    from rsltrace.job.values.times import parse_time  # this alone needs no pydantic

    text = text.strip()
    return parse_time(f"{text}s" if text[-1:] in _ENDS_OF_NUMBERS else text)
