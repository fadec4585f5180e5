"""Where a debugged run stands, as clients see it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rsltrace.trace.model.stamp import format_seconds


@dataclass(frozen=True, slots=True)
class Position:
    """A place between two events. ``index`` is how many have ended, ``stamp_ns`` simulated time.

    ``event`` is the one that has ended last, None before the first: ``index``, ``stamp_ns``,
    ``kind``, ``node``, ``entity`` (topic, service or callback), ``entity_kind``, ``flags``,
    ``cause_event`` (None: no other event's doing), ``cause_output``, ``outputs`` (how many),
    ``state_hash`` and ``chain_hash`` (16 hex digits). ``is_next`` says that the callback of event
    ``index`` is about to begin (a breakpoint stopped there).
    """

    index: int
    stamp_ns: int
    event: dict[str, Any] | None = None
    is_next: bool = False
    next: dict[str, Any] | None = None
    """The event that is about to begin, as far as it is known: ``kind``, ``node``, ``entity``."""

    @property
    def seconds(self) -> str:
        """Simulated time in seconds, with nine decimals."""
        return format_seconds(self.stamp_ns)


@dataclass(frozen=True, slots=True)
class Breakpoint:
    """A breakpoint of a session: a number, and its condition as it was given."""

    number: int
    text: str


@dataclass(frozen=True, slots=True)
class Stopped:
    """Why a session stands where it does.

    ``reason`` is ``step``, ``breakpoint``, ``end`` (of the run), ``begin``, ``paused`` or
    ``diverged`` (the run did not do what it did the first time, see ``text``). ``breakpoint`` is
    the one that was hit, ``text`` says more where there is more to say.
    """

    reason: str
    position: Position
    breakpoint: Breakpoint | None = None
    text: str = ""


def position_of(values: dict[str, Any]) -> Position:
    """Return the position in an answer."""
    return Position(
        index=int(values["index"]),
        stamp_ns=int(values["stamp_ns"]),
        event=values.get("event"),
        is_next=bool(values.get("is_next", False)),
        next=values.get("next"),
    )


def stopped_of(values: dict[str, Any]) -> Stopped:
    """Return what an answer says about a stop."""
    found = values.get("breakpoint")
    return Stopped(
        reason=str(values["reason"]),
        position=position_of(values["position"]),
        breakpoint=None if found is None else Breakpoint(found["number"], found["text"]),
        text=str(values.get("text", "")),
    )
