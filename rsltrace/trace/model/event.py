"""What the loop does (events) and what an event does that others can see (outputs)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag

NO_EVENT = 2**64 - 1
"""The cause of an event that no other event caused."""

NO_SEQUENCE = 2**32 - 1
"""The payload sequence of an output whose payload was not recorded."""


SEGMENT_EVENTS = 4096
"""How many events are written to a trace together, unless a job says fewer."""


class EventKind(IntEnum):
    """Kinds of dispatches by the loop. The numbers are part of the trace format."""

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
        """The name used on screens and in ``--json``: ``guard_condition``."""
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
        """The name used on screens and in ``--json``."""
        return self.name.lower()


@dataclass(frozen=True, slots=True)
class Event:
    """One dispatch by the loop, as the trace holds it. Hashes are unsigned 64-bit integers.

    ``stamp_ns`` is simulated time. ``cause_event`` and ``cause_output`` name the event (and which
    of its outputs) that produced the input, or ``NO_EVENT``.
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
    """One thing an event did that others can see.

    ``event`` is the index of the event, ``entity`` what did it, ``hash`` covers the content.
    ``sequence`` finds the payload among the messages of its channel, or is ``NO_SEQUENCE``.
    """

    event: int
    entity: int
    kind: OutputKind
    hash: int
    sequence: int
