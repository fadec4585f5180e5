"""What the comparison of two recordings finds, and that of two runs of which one is native.

``a`` is always the first one given, ``b`` the second. Log times are integer nanoseconds.
"""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

from rsltrace.diff.facts.evidence import FieldDifference, NoFieldsReason, Presence
from rsltrace.diff.facts.remarks import Remark
from rsltrace.diff.options import EXIT_DIVERGED, EXIT_WITHIN_TOLERANCE
from rsltrace.fast_dataclass import dataclass

if TYPE_CHECKING:
    from rsltrace.trace.timings import DurationStatistics
    from rsltrace.trace.words.entities import EntityKey


class BagVerdict(Enum):
    """How two recordings compare. The set is closed; ``BagDiff.sentence`` puts it in words."""

    EQUAL = "equal"
    WITHIN_TOLERANCE = "equal-within-tolerance"
    AGREE_UNTIL_TRUNCATED = "agree-until-truncated"
    """One of them is truncated, and they agree until then (or are equal within tolerance)."""
    DIFFERENT = "different"


@dataclass(frozen=True, slots=True)
class ComparedRecording:
    """One of the two sides. ``kind`` is ``mcap``, ``sqlite3`` or ``trace``.

    ``complete`` is false for a file that was cut off and read as far as it goes.
    """

    path: str
    kind: str
    topics: int
    messages: int
    start_ns: int
    end_ns: int
    complete: bool = True


@dataclass(frozen=True, slots=True)
class BagMessage:
    """A message of a topic: its number there, counted from 0, its log time, and what it says."""

    index: int
    stamp_ns: int
    preview: str


@dataclass(frozen=True, slots=True)
class MessageDivergence:
    """The first message of a topic that differs, is missing or is extra.

    ``a`` or ``b`` is None where that side has no counterpart. ``after_ns`` is how long after the
    start of its recording the message was logged. ``before`` are the last messages of the topic
    before it (in a, or in b where a has none). ``fields`` and ``more_fields`` say what differs;
    ``no_fields`` why nothing can be. ``moved``: both have the message, but in another place of the
    topic; ``swapped_at``: it changed places with the next one, where a has the first of them.
    """

    topic: str
    type: str
    presence: Presence
    a: BagMessage | None
    b: BagMessage | None
    after_ns: int
    fields: tuple[FieldDifference, ...] = ()
    more_fields: int = 0
    no_fields: NoFieldsReason | None = None
    error: str = ""
    before: tuple[BagMessage, ...] = ()
    moved: bool = False
    swapped_at: int | None = None


@dataclass(frozen=True, slots=True)
class TopicDiff:
    """How the messages of one topic compare; ``first`` is None if nothing but tolerance is between.

    ``equal`` messages are the same bit for bit in every field that is compared, ``tolerated`` ones
    within tolerance, ``ignored`` ones but for fields that are ignored, ``moved`` ones the same
    but in another order. The other counts never include these. ``type_b`` differs from ``type_a``
    only where the recordings disagree about the topic's type.
    """

    topic: str
    type_a: str
    type_b: str
    equal: int
    tolerated: int
    differing: int
    only_a: int
    only_b: int
    first: MessageDivergence | None = None
    ignored: int = 0
    moved: int = 0

    @property
    def diverged(self) -> bool:
        """Whether some message differs, is missing, is extra or changed its place."""
        return bool(self.differing or self.only_a or self.only_b or self.moved)

    @property
    def agreeing(self) -> int:
        """How many messages are equal, also within tolerance or but for fields that are ignored."""
        return self.equal + self.tolerated + self.ignored


@dataclass(frozen=True, slots=True)
class LoneTopic:
    """A topic that only one side has."""

    topic: str
    type: str
    messages: int


@dataclass(frozen=True, slots=True)
class BagComparison:
    """The answer for two recordings. ``exit_code``: 0 equal, 1 not, 3 within tolerance.

    ``topics`` are those that both sides have, in the order of a; ``first`` is the earliest
    divergence of all of them, counted from the start of each recording (with ``--by stamp``: by
    the log time).
    """

    a: ComparedRecording
    b: ComparedRecording
    verdict: BagVerdict
    by: str
    topics: tuple[TopicDiff, ...] = ()
    topics_only_a: tuple[LoneTopic, ...] = ()
    topics_only_b: tuple[LoneTopic, ...] = ()
    first: MessageDivergence | None = None
    next_step: str = ""
    remarks: tuple[Remark, ...] = ()
    allow_truncated: bool = False
    """Whether truncated recordings are accepted."""

    @property
    def identical(self) -> bool:
        """Whether every message is the same, no tolerance needed."""
        return self.verdict is BagVerdict.EQUAL

    @property
    def within_tolerance(self) -> bool:
        """Whether messages differ, but none by more than is tolerated or ignored."""
        return self.verdict is BagVerdict.WITHIN_TOLERANCE

    @property
    def diverged(self) -> bool:
        """Whether some message differs by more than is tolerated, is missing or is extra."""
        return self.verdict is BagVerdict.DIFFERENT

    @property
    def agrees_until_cut(self) -> bool:
        """Whether a recording is cut, and they agree as far as both go."""
        return self.verdict is BagVerdict.AGREE_UNTIL_TRUNCATED

    @property
    def failed(self) -> bool:
        """Whether a test that compares the recordings fails: they differ, or one is cut."""
        return self.exit_code == EXIT_DIVERGED

    @property
    def exit_code(self) -> int:
        """0 equal, 1 different or cut, 3 equal within tolerance; trouble is raised instead."""
        if self.diverged or (self.agrees_until_cut and not self._is_enough):
            return EXIT_DIVERGED
        tolerated = any(topic.tolerated or topic.ignored for topic in self.topics)
        return EXIT_WITHIN_TOLERANCE if tolerated else 0

    @property
    def _is_enough(self) -> bool:
        """Whether truncated recordings are accepted, and something agrees."""
        return self.allow_truncated and any(t.agreeing for t in self.topics)


# -- native runs ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CallbackTimes:
    """When the callbacks of one entity ran, in both runs.

    ``measure`` says of what ``a`` and ``b`` are the spread: ``period``, from one call of a timer to
    the next, or ``latency``, from the start of the callback that caused it.
    """

    entity: EntityKey
    events_a: int
    events_b: int
    measure: str
    a: DurationStatistics | None
    b: DurationStatistics | None


@dataclass(frozen=True, slots=True)
class ExtraMessages:
    """A topic of which ``run`` has ``more`` messages, at its end."""

    topic: str
    more: int
    run: str


@dataclass(frozen=True, slots=True)
class ReorderedCallback:
    """A callback that ran in another order: its events."""

    entity: EntityKey
    event_a: int
    event_b: int


@dataclass(frozen=True, slots=True)
class NativeComparison:
    """``native`` are the sides that are: ``("a",)``. ``content`` compares the messages, topic by
    topic; ``tails`` are topics of which one run has more messages, at its end.

    Of ``compared`` callbacks that both have, ``moved`` ran in another order; ``first_moved`` is the
    first of them.
    """

    native: tuple[str, ...]
    content: BagComparison
    differs: bool
    """Whether a message says something else, or is missing before the end; not whether messages
    changed places."""
    first: MessageDivergence | None
    """The first that does, on a topic that both have."""
    tails: tuple[ExtraMessages, ...]
    compared: int
    moved: int
    first_moved: ReorderedCallback | None
    callbacks: tuple[CallbackTimes, ...]
