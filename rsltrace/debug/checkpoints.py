"""Positions, breakpoints and stops of a session; and which checkpoints to keep."""

from __future__ import annotations

from bisect import bisect_right, insort
from dataclasses import dataclass, field
from typing import Any

from rsltrace.debug.processes import SimProcess
from rsltrace.trace.model.texts import Stamp, format_seconds


@dataclass(frozen=True, slots=True)
class RunPosition:
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
        """Seconds since the start of the run, with nine decimals."""
        return format_seconds(self.stamp_ns)


@dataclass(frozen=True, slots=True)
class Breakpoint:
    """A breakpoint of a session: a number, and its condition as it was given."""

    number: int
    text: str


@dataclass(frozen=True, slots=True)
class StopReport:
    """Why a session stands where it does.

    ``reason`` is ``step``, ``breakpoint``, ``end`` (of the run), ``begin``, ``paused`` or
    ``diverged`` (the run did not do what it did the first time, see ``text``). ``breakpoint`` is
    the one that was hit, ``text`` says more where there is more to say.
    """

    reason: str
    position: RunPosition
    breakpoint: Breakpoint | None = None
    text: str = ""


def position_of(values: dict[str, Any], start_ns: int) -> RunPosition:
    """Return the position of an answer in a run that starts at ``start_ns``."""
    event = values.get("event")
    if event is not None:
        event = {**event, "stamp_ns": Stamp(event["stamp_ns"], start_ns)}
    return RunPosition(
        index=int(values["index"]),
        stamp_ns=Stamp(values["stamp_ns"], start_ns),
        event=event,
        is_next=bool(values.get("is_next", False)),
        next=values.get("next"),
    )


def stopped_of(values: dict[str, Any], start_ns: int) -> StopReport:
    found = values.get("breakpoint")
    return StopReport(
        reason=str(values["reason"]),
        position=position_of(values["position"], start_ns),
        breakpoint=None if found is None else Breakpoint(found["number"], found["text"]),
        text=str(values.get("text", "")),
    )


_NEAR_EVENTS = 2_000
"""Closer to the cursor than this, all places are equally worth a checkpoint."""

COUNT_MAX = 500
"""Each has a socket to the supervisor, which may have a thousand."""

LADDER = (2048, 128, 8)
"""How many events before a goal checkpoints are left on the way there: who goes back one event
goes back another."""


@dataclass(order=True)
class Checkpoint:
    """A sleeping process at an index and time (ns); ``bytes`` is its last measured memory (PSS)."""

    index: int
    stamp_ns: int
    process: SimProcess = field(compare=False)
    bytes: int = field(default=0, compare=False)


class Checkpoints:
    """Checkpoints in the order of their indices, ``count_max`` at most."""

    def __init__(self, count_max: int) -> None:
        self.count_max = count_max
        self._all: list[Checkpoint] = []

    def __len__(self) -> int:
        return len(self._all)

    def all(self) -> list[Checkpoint]:
        return list(self._all)

    def add(self, checkpoint: Checkpoint) -> bool:
        """Add a checkpoint, unless its index has one; return whether it was added."""
        if any(one.index == checkpoint.index for one in self._all):
            return False
        insort(self._all, checkpoint)
        return True

    def remove(self, checkpoint: Checkpoint) -> None:
        self._all = [one for one in self._all if one is not checkpoint]

    def before(self, index: int) -> list[Checkpoint]:
        """Return the checkpoints at ``index`` or before it, the nearest first."""
        at = bisect_right([one.index for one in self._all], index)
        return self._all[:at][::-1]

    def before_time(self, stamp_ns: int) -> list[Checkpoint]:
        """Return the checkpoints no later than a time, the latest first."""
        return [one for one in self._all if one.stamp_ns <= stamp_ns][::-1]

    def least_useful(self, cursor: int) -> Checkpoint | None:
        """Return the checkpoint to drop: the one whose neighbours are closest, relative to the
        distance from the cursor. So checkpoints are log-spaced around it. The first one stays."""
        best, least = None, 0.0
        for place in range(1, len(self._all)):
            one = self._all[place]
            end = (
                self._all[place + 1].index if place + 1 < len(self._all) else max(cursor, one.index)
            )
            gap = end - self._all[place - 1].index
            cost = gap / (abs(one.index - cursor) + _NEAR_EVENTS)
            if best is None or cost < least:
                best, least = one, cost
        return best

    def ladder(self, start: int, goal: int) -> list[int]:
        """Return the indices at which to leave checkpoints between ``start`` and ``goal``."""
        return [goal - step for step in LADDER if goal - step >= start + step]
