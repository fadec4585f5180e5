"""What chance, or a fault of the job, decided, as one number that a trace holds in place of an
output's hash.

The upper 8 bits say what, the lower 56 how many nanoseconds (of a switch between threads: before
which line). It is no hash: a reader gets the value back, so that a diff can name it.
"""

from __future__ import annotations

from enum import IntEnum

from rsltrace.trace.model.stamp import format_duration

_SHIFT = 56
_VALUE_MAX = (1 << _SHIFT) - 1


class Draw(IntEnum):
    """What was decided. The numbers are part of the trace format."""

    DELAY = 1
    DROP = 2
    BURST = 3
    OUTAGE = 4
    DUPLICATE = 5
    EXECUTION = 6
    CLOCK_AHEAD = 7
    CLOCK_BACK = 8
    CRASH = 9
    HANG = 10
    RESTART = 11
    GOES_ON = 12
    SWITCH = 13


_WORDS = {
    Draw.DROP: "lost",
    Draw.BURST: "lost in a burst",
    Draw.OUTAGE: "lost in an outage",
    Draw.CRASH: "crashes",
    Draw.GOES_ON: "goes on",
}


_FAULTS = {
    Draw.HANG: ("hangs", " for"),
    Draw.RESTART: ("crashes and starts again", " after"),
}
_CLOCKS = {Draw.CLOCK_AHEAD: "ahead", Draw.CLOCK_BACK: "back"}


def encode_draw(kind: int, value_ns: int = 0) -> int:
    """Return the number for a decision."""
    return (kind << _SHIFT) | min(value_ns, _VALUE_MAX)


def encode_clock(by_ns: int) -> int:
    """Return the number for a clock that has been set by this much."""
    return encode_draw(Draw.CLOCK_AHEAD if by_ns > 0 else Draw.CLOCK_BACK, abs(by_ns))


def kind_of(number: int) -> Draw | None:
    """Return what was decided, None where a later version knows it."""
    kind = number >> _SHIFT
    return Draw(kind) if kind in {int(one) for one in Draw} else None


def is_switch(number: int) -> bool:
    """Whether a decision lets another thread go on in the middle of a callback."""
    return number >> _SHIFT == Draw.SWITCH


def is_second_copy(number: int) -> bool:
    """Whether a decision sends a message twice."""
    return number >> _SHIFT == Draw.DUPLICATE


def duration_of(number: int, kind: Draw) -> int | None:
    """Return how many nanoseconds a decision of that kind says, None if it is of another kind."""
    return number & _VALUE_MAX if number >> _SHIFT == kind else None


def draw_text(number: int, digits: int = 6) -> str:
    """Return a decision in words: ``delay 5.2 ms``, ``lost in a burst``; times with some digits."""
    draw, value_ns = kind_of(number), number & _VALUE_MAX
    duration = format_duration(value_ns, digits)
    if draw is None:
        return f"draw of kind {number >> _SHIFT}: {value_ns}"
    if draw in _WORDS:
        return _WORDS[draw]
    if draw is Draw.SWITCH:
        return f"another thread goes on before line {value_ns}"
    if draw in _CLOCKS:
        return f"clock set {duration} {_CLOCKS[draw]}"
    if draw in _FAULTS:
        word, more = _FAULTS[draw]
        return word + (f"{more} {duration}" if value_ns else "")
    names = {Draw.DELAY: "delay", Draw.DUPLICATE: "second copy after", Draw.EXECUTION: "takes"}
    return f"{names[draw]} {duration}"
