"""Times as people type them: seconds, or a number with a unit as in a job."""

from __future__ import annotations

_ENDS_OF_NUMBERS = tuple("0123456789.")


def parse_stamp(text: str) -> int:
    """Return a time such as ``1.5``, ``1.5s``, ``20ms`` in nanoseconds. Raises ValueError."""
    from rsltrace.job.values.times import parse_time  # this alone needs no pydantic

    text = text.strip()
    return parse_time(f"{text}s" if text[-1:] in _ENDS_OF_NUMBERS else text)
