"""Words for kinds of events and outputs, and for flags."""

from __future__ import annotations

from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind

SHORT_KINDS = {
    EventKind.CONSTRUCT: "init",
    EventKind.TIMER: "timer",
    EventKind.SUBSCRIPTION: "sub",
    EventKind.SERVICE: "srv",
    EventKind.CLIENT: "client",
    EventKind.GUARD_CONDITION: "guard",
    EventKind.TASK: "task",
    EventKind.RESUME: "resume",
    EventKind.QOS_EVENT: "qos",
    EventKind.BAG: "bag",
    EventKind.SHUTDOWN: "end",
    EventKind.ACTION: "action",
    EventKind.CLOCK_JUMP: "jump",
    EventKind.OUTSIDE: "driver",
    EventKind.FAULT: "fault",
}
"""Kinds of events in at most six letters, for narrow columns."""

_FLAGS = tuple((flag, str(flag.name).lower()) for flag in EventFlag if flag)


def kind_label(kinds: type[EventKind] | type[OutputKind], number: int) -> str:
    """Return the name of a kind; ``kind 99`` for one of a newer rsltrace."""
    try:
        return kinds(number).label
    except ValueError:
        return f"kind {number}"


def flag_names(flags: int) -> list[str]:
    """Return the names of flags: ``raised``, ``suspended``."""
    return [name for flag, name in _FLAGS if flags & flag]
