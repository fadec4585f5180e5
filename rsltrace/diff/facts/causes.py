"""What a divergence is, and where it comes from.

A ``Judgement`` holds both: ``what`` happened, ``why``, and the likely cause. Facts without
values of their own are members of ``DivergenceKind`` and ``CauseKind``.
"""

from __future__ import annotations

from enum import Enum

from rsltrace.diff.facts.evidence import (
    CallDifference,
    EntityChanges,
    EventSummary,
    Fact,
    MessageDifference,
    Setting,
    StateDifference,
)
from rsltrace.fast_dataclass import dataclass


class Verdict(Enum):
    """Why two runs diverge. The set is closed; ``Diff.sentence`` puts it in words."""

    IDENTICAL = "identical"
    AGREE_UNTIL_TRUNCATED = "agree-until-truncated"
    """One of the recordings is truncated, and they agree until then."""
    DIFFERENT_JOBS = "different-jobs"
    """One of the runs has no event to compare, and their jobs or graphs are others."""
    SAME_INPUT_DIFFERENT_OUTPUT = "same-input-different-output"
    DIFFERENT_INPUT = "different-input"
    SCHEDULE = "schedule"
    TIMING = "timing"
    MISSING = "missing"
    EXTRA = "extra"
    ENDED_EARLY = "ended-early"
    RAN_LONGER = "ran-longer"
    EXCEPTION = "exception"
    DRAW = "draw"
    """A random draw for a message: its delay, whether it is lost."""
    GRAPH = "graph"
    ENVIRONMENT = "environment"
    SAME_CONTENT = "same-content"
    """A run is native, and all messages are the same except for times: what differs is timing, and
    perhaps the order of callbacks."""
    OTHER_CONTENT = "other-content"
    """A run is native, and messages say something else, or are missing."""


class Root(Enum):
    """Where the cause chain of a different input ends."""

    EXTERNAL_INPUT = "external-input"
    """A bag message (or another value from outside) is itself different."""
    CALLBACK = "callback"
    """An event whose inputs agree and whose outputs do not."""
    SCHEDULE = "schedule"
    TIMING = "timing"
    MISSING = "missing"
    EXTRA = "extra"
    EXCEPTION = "exception"
    DRAW = "draw"
    """A delay, a loss or an execution time was drawn differently."""
    JOB = "job"
    """Parameters, seed, code: the constructor already behaved differently."""
    UNKNOWN = "unknown"


# -- circumstances -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SleepTimes:
    """How long a callback slept in each run (ns), None where it did not."""

    a: int | None
    b: int | None


@dataclass(frozen=True, slots=True)
class UnfinishedCall(Fact):
    """A call that waited to the end of ``run`` and kept an event from happening there."""

    text: str
    since_ns: int
    run: str


@dataclass(frozen=True, slots=True)
class QueueOverflow(Fact):
    """The queue of a subscription was full in ``run``, where it has a ``depth`` that the other
    run may not have."""

    depth: int
    run: str
    depths: tuple[int | None, int | None] = (None, None)


@dataclass(frozen=True, slots=True)
class NoMoreMessages(Fact):
    """A subscription receives nothing more in ``run``."""

    run: str


Loss = UnfinishedCall | QueueOverflow | NoMoreMessages | EntityChanges
"""Why an event did not happen in one of the runs, as far as that is known."""


# -- what --------------------------------------------------------------------------------------


class DivergenceKind(Enum):
    """What happened, where the events and messages say the rest."""

    CONSTRUCTED_IN_ONE = "constructed-in-one"
    NODE_RENAMED = "node-renamed"
    CONSTRUCTION_ORDER = "construction-order"
    OTHER_ENTITIES = "other-entities"
    OTHER_CONSTRUCTION = "other-construction"
    OTHER_CONSTRUCTION_SAME_JOB = "other-construction-same-job"
    BAG_MESSAGES_SWAPPED = "bag-messages-swapped"
    BAG_MESSAGE_MOVED = "bag-message-moved"
    OTHER_BAG_MESSAGE = "other-bag-message"
    OTHER_FROM_OUTSIDE = "other-from-outside"
    OTHER_DONE_OUTSIDE = "other-done-outside"
    ONLY_ZERO_DELAYS = "only-zero-delays"
    OTHER_SENDER = "other-sender"
    THREAD_SWITCHED = "thread-switched"
    OTHER_STATE = "other-state"


@dataclass(frozen=True, slots=True)
class DifferentOrder(Fact):
    """The same events ran in another order. ``event`` is one that moved."""

    event: EventSummary


@dataclass(frozen=True, slots=True)
class EventInOneRun(Fact):
    """An event that only one run has; ``instead`` is what the other continued with."""

    instead: EventSummary | None = None
    loss: Loss | None = None
    periods_ns: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class ExceptionInOneRun(Fact):
    """An exception in one run only, from the same input."""

    error: str
    after_shutdown: bool = False


@dataclass(frozen=True, slots=True)
class DifferentTime(Fact):
    """An event that both runs have, at another time (or due at another one)."""

    periods_ns: tuple[int, int] | None = None
    slept: SleepTimes | None = None


@dataclass(frozen=True, slots=True)
class DifferentInput(Fact):
    """An event that received something else; ``topic`` is empty if that was no message."""

    topic: str


@dataclass(frozen=True, slots=True)
class DifferentDraw(Fact):
    """A random draw for ``message`` differs, and ``more``. ``connected`` is False where
    one run has nothing to draw for: its output has no receiver there."""

    message: MessageDifference
    more: int
    of_clock: bool
    of_event: bool
    connected: bool


@dataclass(frozen=True, slots=True)
class DifferentOutput(Fact):
    """The same input, another output."""

    slept: SleepTimes | None = None
    only_slept: bool = False


@dataclass(frozen=True, slots=True)
class RunEnd:
    """How one run ended. ``stuck`` says who waited for what, if it ended so."""

    run: str
    end_ns: int
    reason: str
    has_events: bool = True
    exit_code: int = 0
    error: str = ""
    stuck: str = ""
    nothing_left: bool = False
    raised: bool = False


@dataclass(frozen=True, slots=True)
class EarlierEnd(Fact):
    """One run ended; the other was identical until then and continued."""

    over: RunEnd
    other: RunEnd


DivergenceFact = (
    DivergenceKind
    | DifferentOrder
    | EventInOneRun
    | ExceptionInOneRun
    | DifferentTime
    | DifferentInput
    | DifferentDraw
    | DifferentOutput
    | EarlierEnd
    | EntityChanges
)


# -- why ---------------------------------------------------------------------------------------


class CauseKind(Enum):
    """Why, where events, messages and settings say the rest. Settings that can be the cause are
    named instead."""

    CONSTRUCTOR = "constructor"
    READY_AT_ONCE = "ready-at-once"
    ONLY_IN_ONE_BAG = "only-in-one-bag"
    DRIVEN_IN_ONE = "driven-in-one"
    DRIVEN_DIFFERENTLY = "driven-differently"
    FAULT_IN_ONE = "fault-in-one"
    NOTHING_MADE_IT_RUN = "nothing-made-it-run"
    BAGS_SWAPPED = "bags-swapped"
    BAGS_AT_OTHER_TIMES = "bags-at-other-times"
    BAGS_DIFFER = "bags-differ"
    OTHER_CONTENT_ARRIVED = "other-content-arrived"
    SENDER_UNKNOWN = "sender-unknown"
    DELAY_IN_ONE = "delay-in-one"
    EQUAL_MESSAGES_SWAPPED = "equal-messages-swapped"
    STREAM_MOVED = "stream-moved"
    NOT_CONNECTED = "not-connected"
    POLICY_CHOSE = "policy-chose"
    CUT_OFF = "cut-off"
    STOPS_DIFFER = "stops-differ"
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class WaitInOneRun(Fact):
    """A callback that waited, in one run only, for what ``cause`` sent."""

    cause: EventSummary


@dataclass(frozen=True, slots=True)
class NotDelivered(Fact):
    """``cause`` sent it in both runs; it arrived only in one."""

    cause: EventSummary
    loss: Loss | None


@dataclass(frozen=True, slots=True)
class DifferentSenders(Fact):
    """The inputs came from other events."""

    a: EventSummary
    b: EventSummary


@dataclass(frozen=True, slots=True)
class NoEarlierDifference(Fact):
    """Nothing that the traces show differs before. ``doubt`` is what is not deterministic if no
    setting explains it: the kind of what ran, or ``time``."""

    doubt: str
    state_unknown: bool
    guard_is_off: bool


@dataclass(frozen=True, slots=True)
class NoEventsLeft(Fact):
    """``run`` had nothing left to do, since an event is missing in it: see ``alone``."""

    run: str
    alone: Judgement


@dataclass(frozen=True, slots=True)
class Consequence(Fact):
    """A consequence: ``root`` is where the runs diverged before."""

    root: Judgement


@dataclass(frozen=True, slots=True)
class SameCause(Fact):
    """The same as that of ``first``: of an effect, the cause of how its node was set up."""

    first: Judgement


CauseFact = (
    CauseKind
    | WaitInOneRun
    | NotDelivered
    | DifferentSenders
    | NoEarlierDifference
    | NoEventsLeft
    | Consequence
    | SameCause
)


# -- what is likely behind it ------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ExternalAnswers(Fact):
    """``subject`` (a node or main, or empty) got different external answers."""

    subject: str
    calls: tuple[CallDifference, ...]


@dataclass(frozen=True, slots=True)
class SetOrder(Fact):
    """``what`` (``order of the set self.landmarks``) at ``place`` shows in a message; ``more`` such
    lines are there."""

    what: str
    place: str
    more: int = 0


@dataclass(frozen=True, slots=True)
class ErrorInTransition(Fact):
    """A lifecycle callback raised what rclpy suppressed: ``a`` and ``b`` are the exceptions, None
    where a run has none."""

    node: str
    callback: str
    place: str
    a: str | None
    b: str | None


@dataclass(frozen=True, slots=True)
class UnrecordedAnswer(Fact):
    """An unrecorded external answer: a possible cause. ``source`` is the key of
    ``guard:`` that keeps it, "" if none does, ``thread`` of what happens in real time."""

    call: str
    place: str
    source: str


@dataclass(frozen=True, slots=True)
class UnguardedCall(Fact):
    """A call in the code that ran, which no guard watched: a possible cause. ``file`` has it, and
    ``more`` such calls; ``permission`` is what the job says (``guard: false``)."""

    call: str
    place: str
    file: str
    permission: str
    more: int = 0


PossibleCause = UnrecordedAnswer | UnguardedCall


@dataclass(frozen=True, slots=True)
class CallbackAbsence(Fact):
    """Why a callback did not come in ``run``, as `rsltrace why` says it: the kind of ``reason``,
    its ``words``, the line to blame (or empty), and the event there to look at."""

    run: str
    reason: str
    words: str
    place: str
    event: int | None


LikelyCause = ExternalAnswers | SetOrder | ErrorInTransition | EntityChanges | PossibleCause


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict with its reasons.

    ``a`` and ``b`` are the events to show. Of a schedule they are what either run did first: two
    events, not one; else one is None where that run has no counterpart. ``why`` is None where a
    consequence needs none. ``settings`` are those of the settings that differ which can be the
    cause, ``likely`` what came from outside and explains it. ``failed`` is how one of the runs then
    failed, if only one did. ``node_diverged``: it is a consequence of what its node did before.
    """

    verdict: Verdict
    root: Root
    what: DivergenceFact
    why: CauseFact | None
    a: EventSummary | None
    b: EventSummary | None
    messages: tuple[MessageDifference, ...] = ()
    state: tuple[StateDifference, ...] = ()
    settings: tuple[Setting, ...] = ()
    likely: LikelyCause | None = None
    failed: RunEnd | None = None
    node_diverged: bool = False

    @property
    def one(self) -> EventSummary | None:
        """The event, of whichever run has it."""
        return self.a or self.b

    @property
    def changed(self) -> EntityChanges | None:
        """The entities whose properties show in it."""
        if isinstance(self.what, EventInOneRun) and isinstance(self.what.loss, EntityChanges):
            return self.what.loss
        return self.what if isinstance(self.what, EntityChanges) else None

    @property
    def is_unexplained(self) -> bool:
        """Whether something is not deterministic, and nothing that is known explains it."""
        if self.settings:
            return False
        why, one = self.why, self.one
        if isinstance(why, NotDelivered):
            return isinstance(why.loss, NoMoreMessages | EntityChanges)
        if why is CauseKind.NOTHING_MADE_IT_RUN:
            return one is not None and bool(one.entity.node or one.entity.kind in NO_CALLBACKS)
        return why is CauseKind.CONSTRUCTOR or isinstance(why, NoEarlierDifference | WaitInOneRun)


NO_CALLBACKS = ("main", "thread")
"""Kinds of entities that run without being called."""
