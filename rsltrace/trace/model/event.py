"""Events: what the loop runs. Outputs: what an event does that others can see."""

from __future__ import annotations

from enum import IntEnum, IntFlag

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.texts import format_duration


@dataclass(frozen=True, slots=True)
class CodeLine:
    """A line of user code that a run noted: where outputs come from, or what callbacks run.

    ``place`` is ``package/module.py:24``, ``function`` the surrounding function. ``event`` is the
    first whose output number ``output`` of ``entity`` came from there; with ``NO_SEQUENCE`` as
    output, the first event of ``entity`` that ran the function defined there. Without a place, only
    some later outputs of the same callback through ``entity`` are noted.
    """

    event: int
    entity: int
    output: int
    place: str
    function: str


# A random decision, or a fault of the job, as one number in place of an output's hash. The upper 8
# bits are the kind, the lower 56 a duration in nanoseconds (for a switch between threads: the
# line). It is no hash, so a diff can show it.

_SHIFT = 56
_VALUE_MAX = (1 << _SHIFT) - 1


class RandomDecision(IntEnum):
    """Kinds of decisions. The numbers are part of the trace format."""

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
    RandomDecision.DROP: "lost",
    RandomDecision.BURST: "lost in a burst",
    RandomDecision.OUTAGE: "lost in an outage",
    RandomDecision.CRASH: "crashes",
    RandomDecision.GOES_ON: "goes on",
}


_FAULTS = {
    RandomDecision.HANG: ("hangs", " for"),
    RandomDecision.RESTART: ("crashes and starts again", " after"),
}
_CLOCKS = {RandomDecision.CLOCK_AHEAD: "ahead", RandomDecision.CLOCK_BACK: "back"}


def encode_decision(kind: int, value_ns: int = 0) -> int:
    """Return the number for a decision."""
    return (kind << _SHIFT) | min(value_ns, _VALUE_MAX)


def encode_clock_change(by_ns: int) -> int:
    """Return the number for a clock that was set by this much."""
    return encode_decision(
        RandomDecision.CLOCK_AHEAD if by_ns > 0 else RandomDecision.CLOCK_BACK, abs(by_ns)
    )


def decision_kind(number: int) -> RandomDecision | None:
    """Return the kind of a decision, None if a newer version wrote it."""
    kind = number >> _SHIFT
    return RandomDecision(kind) if kind in {int(one) for one in RandomDecision} else None


def is_switch(number: int) -> bool:
    """Whether a decision lets another thread continue in the middle of a callback."""
    return number >> _SHIFT == RandomDecision.SWITCH


def is_second_copy(number: int) -> bool:
    """Whether a decision sends a message twice."""
    return number >> _SHIFT == RandomDecision.DUPLICATE


def decision_duration(number: int, kind: RandomDecision) -> int | None:
    """Return the duration of a decision of that kind in nanoseconds, None for another kind."""
    return number & _VALUE_MAX if number >> _SHIFT == kind else None


def decision_text(number: int, digits: int = 6) -> str:
    """Return a decision in words: ``delay 5.2 ms``, ``lost in a burst``."""
    draw, value_ns = decision_kind(number), number & _VALUE_MAX
    duration = format_duration(value_ns, digits)
    if draw is None:
        return f"draw of kind {number >> _SHIFT}: {value_ns}"
    if draw in _WORDS:
        return _WORDS[draw]
    if draw is RandomDecision.SWITCH:
        return f"another thread goes on before line {value_ns}"
    if draw in _CLOCKS:
        return f"clock set {duration} {_CLOCKS[draw]}"
    if draw in _FAULTS:
        word, more = _FAULTS[draw]
        return word + (f"{more} {duration}" if value_ns else "")
    names = {
        RandomDecision.DELAY: "delay",
        RandomDecision.DUPLICATE: "second copy after",
        RandomDecision.EXECUTION: "takes",
    }
    return f"{names[draw]} {duration}"


NO_EVENT = 2**64 - 1
"""The cause of an event that no other event caused."""

NO_SEQUENCE = 2**32 - 1
"""The payload sequence of an output whose payload was not recorded."""


SEGMENT_EVENTS = 4096
"""The number of events written to a trace together, unless a job sets fewer."""


class EventKind(IntEnum):
    """Kinds of events. The numbers are part of the trace format."""

    CONSTRUCT = 1
    TIMER = 2
    SUBSCRIPTION = 3
    SERVICE = 4
    CLIENT = 5
    GUARD_CONDITION = 6
    TASK = 7
    RESUME = 8
    QOS_EVENT = 9
    BAG = 10
    SHUTDOWN = 11
    ACTION = 12
    CLOCK_JUMP = 13
    OUTSIDE = 14
    FAULT = 15

    @property
    def label(self) -> str:
        """The name shown, also with ``--json``: ``guard_condition``."""
        return self.name.lower()


class EventFlag(IntFlag):
    """What else happened in an event."""

    NONE = 0
    RAISED = 1
    SUSPENDED = 2


class OutputKind(IntEnum):
    """Kinds of outputs. The numbers are part of the trace format."""

    MESSAGE = 1
    REQUEST = 2
    RESPONSE = 3
    LOG = 4
    EXCEPTION = 5
    TIMER = 6
    ENTITY = 7
    GUARD = 8
    TASK = 9
    SHUTDOWN = 10
    DRAW = 11

    @property
    def label(self) -> str:
        """The name shown, also with ``--json``."""
        return self.name.lower()


@dataclass(frozen=True, slots=True)
class EventRecord:
    """One event of the loop. Hashes are unsigned 64-bit integers.

    ``stamp_ns`` is simulated time. ``cause_event`` and ``cause_output`` name the event, and its
    output, that produced the input; or ``NO_EVENT``.
    """

    index: int
    stamp_ns: int
    entity: int
    kind: EventKind
    flags: EventFlag
    cause_event: int
    cause_output: int
    outputs: int
    input_hash: int
    output_hash: int
    state_hash: int
    chain_hash: int


@dataclass(frozen=True, slots=True)
class Output:
    """Something that an event did and others can see.

    ``event`` is the index of the event, ``entity`` what did it, ``hash`` covers the content.
    ``sequence`` is the number of the payload in its channel, or ``NO_SEQUENCE``.
    """

    event: int
    entity: int
    kind: OutputKind
    hash: int
    sequence: int
