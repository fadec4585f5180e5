"""What else there is to know of a comparison, and the answer it comes to."""

from __future__ import annotations

from enum import Enum

from rsltrace.diff.facts.evidence import Fact
from rsltrace.fast_dataclass import dataclass


@dataclass(frozen=True, slots=True)
class ReaderNote(Fact):
    """A note of the reader of a recording."""

    text: str


@dataclass(frozen=True, slots=True)
class TruncatedRecording(Fact):
    """The recording of ``run`` is cut off."""

    run: str
    path: str
    events: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class DifferentStarts(Fact):
    """The runs start at different simulated times."""

    a_ns: int
    b_ns: int


@dataclass(frozen=True, slots=True)
class EndedByException(Fact):
    """An exception ended ``run``, and not the other one."""

    run: str
    reason: str
    event: int
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class DifferentEnd(Fact):
    """Identical events, another ``what`` (reason, exit code)."""

    what: str
    a: str | None
    b: str | None


@dataclass(frozen=True, slots=True)
class RenamedProgram(Fact):
    """Two names of one program."""

    a: str
    b: str


@dataclass(frozen=True, slots=True)
class SelectionIsEqual(Fact):
    """No difference among the selected names (globs)."""

    asked: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SelectionDivergesLater(Fact):
    """The runs diverge at event ``start``; shown is where a selected name differs."""

    start: int
    asked: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class StartIsTolerated(Fact):
    """At event ``start`` all that differs is ignored or within tolerance; shown is what is not."""

    start: int


@dataclass(frozen=True, slots=True)
class ZeroDelaysBefore(Fact):
    """From event ``start`` on one run adds delays of 0 ns; shown is what differs in more."""

    start: int


@dataclass(frozen=True, slots=True)
class MoreDivergences(Fact):
    """Divergences that are not listed."""

    count: int
    all_shown: bool


@dataclass(frozen=True, slots=True)
class NoRecordCommand(Fact):
    """There is no command to record a trace again: it takes ``options`` that could run code, or
    the ``job`` is not here."""

    trace: str
    options: tuple[str, ...] = ()
    job: str = ""


@dataclass(frozen=True, slots=True)
class JobChanged(Fact):
    """The job file here is not what a trace was recorded with."""

    trace: str
    job: str


@dataclass(frozen=True, slots=True)
class LogTimesIgnored(Fact):
    """Log times of recordings are not compared."""


@dataclass(frozen=True, slots=True)
class DifferentType(Fact):
    """A topic that has another type in each recording."""

    topic: str
    a: str
    b: str


@dataclass(frozen=True, slots=True)
class UndecodedMessages(Fact):
    """Messages that could not be decoded."""

    error: str


Remark = (
    ReaderNote
    | TruncatedRecording
    | DifferentStarts
    | EndedByException
    | DifferentEnd
    | RenamedProgram
    | SelectionIsEqual
    | SelectionDivergesLater
    | StartIsTolerated
    | ZeroDelaysBefore
    | MoreDivergences
    | NoRecordCommand
    | JobChanged
    | LogTimesIgnored
    | DifferentType
    | UndecodedMessages
)


# -- the answer --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Identical(Fact):
    """All events are the same; ``names_differ``: except for program names."""

    events: int
    digest: str = ""
    names_differ: bool = False


@dataclass(frozen=True, slots=True)
class EqualUntilTruncated(Fact):
    """They agree as far as the recordings go that are ``cut``."""

    events: int
    cut: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class DifferentJobs(Fact):
    """The runs in ``empty`` have no event to compare."""

    jobs: tuple[str, str]
    empty: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RunsDiverge(Fact):
    """See the divergences. ``searched_to`` is the event up to which no effect of another set-up, or
    of delays of 0 ns, was found (-1: to the end), None if none was looked for, or one was found.
    ``foreign`` are the names of the jobs where the runs have no node in common."""

    searched_to: int | None = None
    foreign: tuple[str, ...] | None = None


@dataclass(frozen=True, slots=True)
class NativeRuns(Fact):
    """See ``Diff.native``."""


Outcome = Identical | EqualUntilTruncated | DifferentJobs | RunsDiverge | NativeRuns


# -- which of two runs a third one repeats -------------------------------------------------------


class Repeats(Enum):
    """What a third run did where two diverge."""

    A = "a"
    B = "b"
    NEITHER = "a third result"
    TOO_SHORT = "too short"


@dataclass(frozen=True, slots=True)
class RepeatedRun:
    """The answer. ``place`` is the event where a and b diverge, None if they do not; ``from_a`` and
    ``from_b`` are the events from which on the third run differs from each."""

    repeats: Repeats
    again: str
    place: int | None
    from_a: int | None
    from_b: int | None
