"""What a diff says: frozen values that the engine fills and the reports print.

``a`` is always the first file given, ``b`` the second. Stamps are simulated nanoseconds, hashes
unsigned 64-bit. A report must be able to print a ``Diff`` without opening the files again.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING

from rsltrace.model.event import EventFlag, EventKind, OutputKind

if TYPE_CHECKING:
    from rsltrace.diff.bags.model import BagDiff

EXIT_PARTED = 1
EXIT_WITHIN_TOLERANCE = 3
"""Neither identical (0) nor parted (1), and not what others use for trouble (2)."""


class Verdict(Enum):
    """Why two runs part. The set is closed; ``Diff.sentence`` puts it in words."""

    IDENTICAL = "identical"
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
    """What chance decided about a message: its delay, whether it is lost."""
    GRAPH = "graph"
    ENVIRONMENT = "environment"


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


@dataclass(frozen=True, slots=True)
class EntityKey:
    """An entity as it is named in both runs, whatever its id is there.

    ``ordinal`` tells apart entities that are otherwise alike: 0, 1, … in creation order.
    """

    node: str
    kind: str
    name: str
    type: str
    ordinal: int = 0

    def __str__(self) -> str:
        number = f" #{self.ordinal + 1}" if self.ordinal else ""
        return f"{self.node or '(run)'}: {self.kind} {self.name}{number}"


@dataclass(frozen=True, slots=True)
class EventView:
    """One event of one run, resolved for printing.

    ``position`` counts the events of this entity before it; -1 far into a long run, where counting
    would mean reading all of it. A constructor goes by the node it makes. ``summary`` is a short
    text of its outputs (``/t1, call /s1``).
    """

    index: int
    stamp_ns: int
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


ENDED_BY_EXCEPTION = "ended by an exception"
"""In the note of a run that ended so, after its letter."""

ULP_TOLD_MAX = 1_000_000
"""Reports tell smaller distances in units in the last place: larger ones are no rounding."""


@dataclass(frozen=True, slots=True)
class FieldDifference:
    """One field in which two decoded messages differ.

    ``path`` as in ``pose.pose.position.x`` or ``ranges[17]``; values as printable text. For
    numbers ``absolute`` is |a-b| and ``ulp`` the distance in units in the last place (floats of
    the field's own width); ``note`` calls out NaN, -0.0, infinities, lengths. For arrays and
    binary fields ``elements`` says how many differ of how many, ``first`` lists the first few as
    (index, a, b) (binary: offset of a row of 16 bytes, and the row as hex), ``smallest`` and
    ``largest`` are the least and greatest |a-b|, ``ulp`` is the greatest. Times and durations are
    one field, in seconds. ``within_tolerance`` is set when a tolerance covers the difference.
    """

    path: str
    a: str
    b: str
    absolute: float | None = None
    ulp: int | None = None
    note: str = ""
    elements: tuple[int, int] | None = None
    first: tuple[tuple[int, str, str], ...] = ()
    smallest: float | None = None
    largest: float | None = None
    within_tolerance: bool = False


@dataclass(frozen=True, slots=True)
class MessageDifference:
    """One input or output that differs between the two events of a divergence.

    ``position`` is the output's place in its event, or -1 for the input. ``presence`` is ``both``,
    ``only a`` or ``only b``. ``fields`` is empty when a payload was not recorded; ``reason`` then
    says so, and how to record it. ``preview`` is the decoded message as one short line where only
    one side has it (of an exception: its last line). A new entity has hash 0: it is known by name.
    """

    kind: OutputKind | None
    topic: str
    type: str
    position: int
    presence: str
    hash_a: int | None
    hash_b: int | None
    fields: tuple[FieldDifference, ...] = ()
    more_fields: int = 0
    preview: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class CallDifference:
    """A call whose answer came from outside, in a diverging event or (``event_*``) before it.

    ``a`` and ``b`` are what it gave, as text; None where a run did not make the call.
    """

    source: str
    call: str
    where: str
    event_a: int | None
    event_b: int | None
    a: str | None
    b: str | None


@dataclass(frozen=True, slots=True)
class StateDifference:
    """A value in a node's state that differs after a diverging event: ``estimator.P[2][2]``.

    ``a`` and ``b`` are printable; None where a state has no such value.
    """

    path: str
    a: str | None
    b: str | None


@dataclass(frozen=True, slots=True)
class CauseStep:
    """One step of the way from the root to the divergence, root first.

    ``relation`` says how it leads to the next step: ``published /odom``, ``called /plan``, …
    A few steps that led to the root may stand before it; they agree in both runs (``a`` and ``b``
    are equal).
    """

    a: EventView | None
    b: EventView | None
    relation: str = ""


@dataclass(frozen=True, slots=True)
class Reach:
    """A topic that the divergence reaches, and how long (simulated ns) after it."""

    topic: str
    after_ns: int
    events: int


@dataclass(frozen=True, slots=True)
class Divergence:
    """One place where the runs part. ``independent`` ones follow from no earlier one.

    ``a`` or ``b`` is None where that run has no counterpart. Of a schedule they are what either run
    did first: two events, not one. ``root`` and ``root_sentence`` say where it comes from; for most
    verdicts that is the diverging event itself. ``before_a``/``before_b``
    are the last events before it in each run, ``same_node_*`` the last ones in the same node.
    """

    verdict: Verdict
    sentence: str
    a: EventView | None
    b: EventView | None
    root: Root
    root_sentence: str
    chain: tuple[CauseStep, ...] = ()
    messages: tuple[MessageDifference, ...] = ()
    before_a: tuple[EventView, ...] = ()
    before_b: tuple[EventView, ...] = ()
    same_node_a: tuple[EventView, ...] = ()
    same_node_b: tuple[EventView, ...] = ()
    reaches: tuple[Reach, ...] = ()
    next_step: str = ""
    calls: tuple[CallDifference, ...] = ()
    state: tuple[StateDifference, ...] = ()


@dataclass(frozen=True, slots=True)
class EntityCount:
    """How the events of one entity compare, over the part of the runs that was aligned."""

    entity: EntityKey
    matching: int
    differing: int
    only_a: int
    only_b: int


@dataclass(frozen=True, slots=True)
class Setting:
    """A difference outside of the events: keys of the job, versions, entities of the graph.

    ``place`` is ``job.yaml:12``, ``job`` (of no line), ``environment: numpy``, ``entity``; ``key``
    is that of a job as ``--set`` takes it, or empty. ``a``/``b`` are None where a side has nothing
    there.
    """

    place: str
    a: str | None
    b: str | None
    key: str = ""

    def __str__(self) -> str:
        return f"{self.place}: {self.key}" if self.key else self.place


@dataclass(frozen=True, slots=True)
class Side:
    """One of the two files."""

    path: str
    digest: str
    events: int
    end_ns: int
    complete: bool
    stop_reason: str = ""


@dataclass(frozen=True, slots=True)
class Diff:
    """The answer. ``exit_code``: 0 identical, 1 diverged, 3 equal within tolerance.

    ``verdict`` and ``sentence`` are those of the first divergence. ``agreeing`` is how many events
    are the same before it. ``settings`` lists what differs in job and environment. ``counts`` and
    ``resync_index`` (indexes in a and b from which on the runs agree again, if they do) cover the
    events from the divergence to ``aligned_to`` (indexes in a and b; all of both with ``--all``).
    ``tolerance`` compares all messages of both runs, if tolerances were given and no event is
    missing, extra or at another time; else it is None.
    """

    a: Side
    b: Side
    verdict: Verdict
    sentence: str
    agreeing: int
    divergences: tuple[Divergence, ...] = ()
    settings: tuple[Setting, ...] = ()
    counts: tuple[EntityCount, ...] = ()
    resync_index: tuple[int, int] | None = None
    aligned_to: tuple[int, int] = (0, 0)
    bytes_read: int = 0
    notes: tuple[str, ...] = field(default=())
    tolerance: BagDiff | None = None

    @property
    def identical(self) -> bool:
        """Whether the two runs did the same."""
        return self.verdict is Verdict.IDENTICAL

    @property
    def within_tolerance(self) -> bool:
        """Whether the runs are not identical, but every message is within what is tolerated."""
        return self.tolerance is not None and not self.tolerance.parted

    @property
    def parted(self) -> bool:
        """Whether the runs did not do the same, and not even within tolerance."""
        return self.exit_code == EXIT_PARTED

    @property
    def exit_code(self) -> int:
        """0 identical, 1 diverged, 3 equal within tolerance; trouble is raised instead."""
        if self.identical:
            return 0
        return EXIT_WITHIN_TOLERANCE if self.within_tolerance else EXIT_PARTED


def exit_code_of_several(codes: Iterable[int]) -> int:
    """Return the worst: parted, then within tolerance, then identical."""
    found = set(codes)
    return next((code for code in (EXIT_PARTED, EXIT_WITHIN_TOLERANCE) if code in found), 0)
