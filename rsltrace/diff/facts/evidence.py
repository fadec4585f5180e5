"""What differs between two runs, piece by piece: settings, events, fields, messages, calls, states.

``a`` is always the first run given, ``b`` the second.
"""

from __future__ import annotations

from enum import Enum

from rsltrace.diff.row_sign import RowSign
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind
from rsltrace.trace.model.texts import Stamp
from rsltrace.trace.words.entities import EntityKey


@dataclass(frozen=True, slots=True)
class Fact:
    """Anything that JSON names by its class."""


class Presence(str, Enum):
    """Which of the runs, or recordings, something is in."""

    BOTH = "both"
    ONLY_A = "only a"
    ONLY_B = "only b"


# -- how the runs were made --------------------------------------------------------------------


class SettingKind(Enum):
    """What a setting is of."""

    JOB = "job"
    CODE = "code"
    FILE = "file"
    ENVIRONMENT = "environment"
    EDITS = "edits"
    ENTITY = "entity"


@dataclass(frozen=True, slots=True)
class Setting:
    """A difference outside of the events.

    ``name`` is that of the job file, the module, the file, the package (or variable). ``line`` is
    where the job file has it (0: nowhere), ``key`` the key of a job as ``--set`` takes it, or empty
    where only lines could be compared. ``a``/``b`` are None where a side has nothing there.
    """

    kind: SettingKind
    name: str
    a: str | None
    b: str | None
    key: str = ""
    line: int = 0

    @property
    def part(self) -> str:
        """The key's first part: ``delay`` of ``delay.topics./scan``."""
        return self.key.partition(".")[0]

    @property
    def place(self) -> str:
        """``job.yaml:12``, ``job`` (of no line), ``code of module m``, ``environment: numpy``."""
        if self.kind is SettingKind.JOB:
            return f"{self.name}:{self.line}" if self.line else "job" if self.key else self.name
        if self.kind is SettingKind.CODE:
            return f"code of module {self.name}"
        if self.kind is SettingKind.ENVIRONMENT:
            return f"environment: {self.name}"
        return f"{self.kind.value} {self.name}".rstrip()


# -- events ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class EventSummary:
    """One event of one run, with names in place of numbers.

    ``position`` counts the events of this entity before it; -1 far into a long run, where counting
    would mean reading all of it. A constructor goes by the node it makes. ``summary`` is a short
    text of its outputs (``/t1, call /s1``), ``code`` where the function that ran is
    (``module.py:24``): by its path in the working directory if it is found below that.
    """

    index: int
    stamp_ns: Stamp
    entity: EntityKey
    kind: EventKind
    flags: EventFlag
    cause_event: int
    cause_output: int
    input_hash: int
    output_hash: int
    state_hash: int
    outputs: int
    position: int
    summary: str = ""
    code: str = ""

    @property
    def node(self) -> str:
        """The full name of the node it is of; a constructor's is the one it makes."""
        return node_of(self.entity)

    @property
    def raised(self) -> bool:
        """Whether it ended with an exception."""
        return bool(self.flags & EventFlag.RAISED)


def node_of(entity: EntityKey) -> str:
    """Return the full name of the node that an entity is, or belongs to."""
    return entity.name if entity.kind == EntityKind.NODE.label else entity.node


# -- fields ------------------------------------------------------------------------------------

ULP_SHOWN_MAX = 1_000_000
"""Up to this, reports show a distance in units in the last place."""


class FieldNoteKind(Enum):
    """What is special about two values."""

    OTHER_TYPES = "other-types"
    NO_SUCH_FIELD = "no-such-field"
    LENGTHS = "lengths"
    SAME_ELEMENTS = "same-elements"
    SAME_WORDS = "same-words"
    FIRST_BYTE = "first-byte"
    FIRST_CHARACTER = "first-character"
    CONSTANTS = "constants"
    NAN_PAYLOAD = "nan-payload"
    NAN_IN_A = "nan-in-a"
    NAN_IN_B = "nan-in-b"
    INFINITE_IN_A = "infinite-in-a"
    INFINITE_IN_B = "infinite-in-b"
    OPPOSITE_INFINITIES = "opposite-infinities"
    SIGN_OF_ZERO = "sign-of-zero"


@dataclass(frozen=True, slots=True)
class FieldNote:
    """``a`` and ``b`` are what it says of both sides: lengths, names of constants; ``a`` alone a
    place. ``count`` is of how many elements of an array it holds (0: of the value itself)."""

    kind: FieldNoteKind
    a: int | str | None = None
    b: int | str | None = None
    count: int = 0


@dataclass(frozen=True, slots=True)
class FieldDifference:
    """One field in which two decoded messages differ.

    ``path`` as in ``pose.pose.position.x`` or ``ranges[17]``; values as printable text. For
    numbers ``absolute`` is |a-b| and ``ulp`` the distance in units in the last place (floats of
    the field's own width). For arrays and binary fields ``elements`` says how many differ of how
    many, ``first`` lists the first few as (index, a, b) (binary: offset of a row of 16 bytes, and
    the row as hex), ``smallest`` and ``largest`` are the least and greatest |a-b|, ``ulp`` is the
    greatest. Times and durations are one field, in seconds. ``within_tolerance`` is set when a
    tolerance covers the difference.
    """

    path: str
    a: str
    b: str
    absolute: float | None = None
    ulp: int | None = None
    notes: tuple[FieldNote, ...] = ()
    elements: tuple[int, int] | None = None
    first: tuple[tuple[int, str, str], ...] = ()
    smallest: float | None = None
    largest: float | None = None
    within_tolerance: bool = False
    binary: bool = False

    def note_of(self, *kinds: FieldNoteKind) -> FieldNote | None:
        """Return the first note of one of some kinds, if there is one."""
        return next((note for note in self.notes if note.kind in kinds), None)

    @property
    def is_reordered(self) -> bool:
        """Whether both sides hold the same in another order: it may be that of a set."""
        return self.note_of(FieldNoteKind.SAME_ELEMENTS, FieldNoteKind.SAME_WORDS) is not None


# -- messages and other outputs ----------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class OutputOrder(Fact):
    """An output that both runs have, in another order."""


@dataclass(frozen=True, slots=True)
class SendCount(Fact):
    """How often both runs sent the same."""

    a: int
    b: int


@dataclass(frozen=True, slots=True)
class SendDelay(Fact):
    """A run sent the same, later."""

    by_ns: int
    run: str


@dataclass(frozen=True, slots=True)
class TimerCancellation(Fact):
    """A timer was cancelled, in one run."""

    run: str


@dataclass(frozen=True, slots=True)
class TimerPeriod(Fact):
    """A timer got another period, in one run; ``before_ns`` is None if the old one is unknown.
    ``run`` is "" if its period is ``before_ns`` in a and ``after_ns`` in b."""

    before_ns: int | None
    after_ns: int
    run: str = ""


@dataclass(frozen=True, slots=True)
class ParameterValues(Fact):
    """Parameters that only one run set: (name, value)."""

    values: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class ParameterChanges(Fact):
    """Parameters that both runs set, to another value: (name, a, b)."""

    values: tuple[tuple[str, str, str], ...]


OutputFate = (
    OutputOrder
    | SendCount
    | SendDelay
    | TimerCancellation
    | TimerPeriod
    | ParameterValues
    | ParameterChanges
)
"""What became of an output."""


NO_ENTITY = EntityKey("", "", "", "")


class NoFieldsReason(Enum):
    """Why no field of a message is shown."""

    ALL_IGNORED = "all-ignored"
    EQUAL_FIELDS = "equal-fields"
    NOT_RECORDED_IN_A = "not-recorded-in-a"
    NOT_RECORDED_IN_B = "not-recorded-in-b"
    UNREADABLE = "unreadable"
    UNDESCRIBED_BYTES = "undescribed-bytes"


@dataclass(frozen=True, slots=True)
class MessageDifference:
    """One input or output that differs between the two events of a divergence.

    ``topic`` is the topic or service, or what else the output is (``timer Arm.control``), of
    ``entity``. ``position`` is the output's place in its event, or -1 for the input. ``fields`` is
    empty when a payload was not recorded; ``no_fields`` then says so, ``error`` why it cannot be
    read. ``fate`` is what became of it. ``preview`` is the decoded message as one short line where
    only one side has it (of an exception: type and text). A new entity has hash 0: it is known by
    name. ``code`` are the lines it may have come from (``module.py:31``), of both runs,
    ``elsewhere`` the last where the run did not look.
    """

    kind: OutputKind | None
    topic: str
    type: str
    position: int
    presence: Presence
    hash_a: int | None
    hash_b: int | None
    fields: tuple[FieldDifference, ...] = ()
    more_fields: int = 0
    preview: str = ""
    no_fields: NoFieldsReason | None = None
    error: str = ""
    fate: OutputFate | None = None
    code: tuple[str, ...] = ()
    entity: EntityKey = NO_ENTITY

    @property
    def is_covered(self) -> bool:
        """Whether all that differs in it is ignored or within tolerance."""
        if self.fields:  # what nothing covers comes first
            return self.fields[0].within_tolerance
        return self.no_fields is NoFieldsReason.ALL_IGNORED

    @property
    def is_input(self) -> bool:
        """Whether it is what the event received."""
        return self.position < 0


@dataclass(frozen=True, slots=True)
class EventRow:
    """A row of both runs, as the viewer shows it: an event of a, of b, or the same of both.

    ``elsewhere`` is the number of the event in the other run, where that has it in another row,
    which ``is_below`` this one or above. ``messages`` is in what the two differ.
    """

    a: EventSummary | None
    b: EventSummary | None
    sign: RowSign
    elsewhere: int | None = None
    is_below: bool = False
    messages: tuple[MessageDifference, ...] = ()


# -- entities ----------------------------------------------------------------------------------


class EntityProperty(Enum):
    """What of an entity is no part of its identity."""

    QOS = "QoS"
    GROUP = "callback group"


@dataclass(frozen=True, slots=True)
class EntityChange:
    """An entity that both runs made, with another property: (name, a, b) as texts, or nanoseconds,
    None where a side has none. The name is that of a policy, or empty.

    ``peers`` are, in ``run`` and not in the other one, the endpoints that a QoS does not match, or
    the entities of the same callback group.
    """

    entity: EntityKey
    property: EntityProperty
    values: tuple[tuple[str, str | int | None, str | int | None], ...]
    peers: tuple[EntityKey, ...] = ()
    run: str = ""


@dataclass(frozen=True, slots=True)
class EntityChanges(Fact):
    """Entities that both runs made, with other properties."""

    changes: tuple[EntityChange, ...]

    @property
    def nodes(self) -> frozenset[str]:
        """The nodes that made them."""
        return frozenset(node_of(change.entity) for change in self.changes)

    @property
    def node(self) -> str:
        """The node that made the first of them."""
        return node_of(self.changes[0].entity)


# -- calls and states --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CallDifference:
    """A call whose answer came from outside, in a diverging event or (``event_*``) before it.

    ``a`` and ``b`` are what it gave, as text; None where a run did not make the call. ``subject``
    is what it asked for (``MOTOR_SEED``, ``gains.yaml``), ``short`` what distinguishes the answers.
    ``only_touched``: nothing of a file differs but when it was written.
    """

    source: str
    call: str
    where: str
    event_a: int | None
    event_b: int | None
    a: str | None
    b: str | None
    subject: str = ""
    short: tuple[str, str] = ("", "")
    only_touched: bool = False

    @property
    def differs(self) -> bool:
        """Whether the answers do."""
        return self.a != self.b


@dataclass(frozen=True, slots=True)
class StateDifference:
    """A value in a node's state that differs after a diverging event: ``estimator.P[2][2]``.

    ``a`` and ``b`` are printable; None where a state has no such value.
    """

    path: str
    a: str | None
    b: str | None


# -- the way from the root, and on -------------------------------------------------------------


class CauseLinkKind(Enum):
    """How an event led to the next one of a chain."""

    NOTHING = ""
    PUBLISHED = "published"
    CALLED = "called"
    ANSWERED = "answered"
    LOGGED = "logged to"
    TRIGGERED = "triggered"
    MADE_TASK = "made or resumed a task of"
    CAUSED = "caused"
    CHANGED_STATE = "may have changed the state of"
    DRAWN_AGAIN = "draws a different value in"
    MADE_RECEIVER = "made a receiver of"
    KEEPS_WAITING = "keeps waiting"
    ENDED_BEFORE = "ended before"
    MORE_STEPS = "more steps"


@dataclass(frozen=True, slots=True)
class CauseLink:
    """How an event led to the next: over which topic, node, …, or over how many ``steps``."""

    kind: CauseLinkKind = CauseLinkKind.NOTHING
    name: str = ""
    steps: int = 0


@dataclass(frozen=True, slots=True)
class CauseStep:
    """One step of the way from the root to the divergence, root first.

    ``link`` says how it leads to the next step. A few steps that led to the root may stand before
    it; they agree in both runs (``a`` and ``b`` are equal).
    """

    a: EventSummary | None
    b: EventSummary | None
    link: CauseLink = CauseLink()


@dataclass(frozen=True, slots=True)
class AffectedTopic:
    """A topic that the divergence reaches, and how long (simulated ns) after it.

    ``moved_ns``: the first message is the same one in b, only so much later (negative: earlier).
    """

    topic: str
    after_ns: int
    events: int
    moved_ns: int = 0
