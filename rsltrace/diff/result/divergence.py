"""One divergence of two runs: the verdict, the events, and what explains it."""

from __future__ import annotations

from dataclasses import dataclass

from rsltrace.diff.result.events import EventView
from rsltrace.diff.result.fields import FieldDifference
from rsltrace.diff.result.settings import Setting
from rsltrace.diff.result.verdicts import Root, Verdict
from rsltrace.model.event import OutputKind

ALL_IGNORED = "all fields that differ are ignored"
"""The reason of a difference without fields that are compared."""


@dataclass(frozen=True, slots=True)
class MessageDifference:
    """One input or output that differs between the two events of a divergence.

    ``position`` is the output's place in its event, or -1 for the input. ``presence`` is ``both``,
    ``only a`` or ``only b``. ``fields`` is empty when a payload was not recorded; ``reason`` then
    says so, and how to record it. ``note`` says in a few words what became of it: ``in another
    order``, ``twice in b``, ``4 ms later in b``, ``cancelled in a``. ``preview`` is the decoded
    message as one short line where only one side has it (of an exception: its last line). A new
    entity has hash 0: it is known by name. ``code`` are the lines it may have come from
    (``module.py:31``), of both runs, ``elsewhere`` the last where the run did not look.
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
    note: str = ""
    code: tuple[str, ...] = ()

    @property
    def is_covered(self) -> bool:
        """Whether all that differs in it is ignored or within tolerance."""
        if self.fields:  # what nothing covers comes first
            return self.fields[0].within_tolerance
        return self.reason == ALL_IGNORED


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
    """A topic that the divergence reaches, and how long (simulated ns) after it.

    ``moved_ns``: the first message is the same one in b, only so much later (negative: earlier).
    """

    topic: str
    after_ns: int
    events: int
    moved_ns: int = 0


@dataclass(frozen=True, slots=True)
class Divergence:
    """One place where the runs diverge. ``independent`` ones follow from no earlier one.

    ``a`` or ``b`` is None where that run has no counterpart. Of a schedule they are what either run
    did first: two events, not one. ``root`` and ``root_sentence`` say where it comes from; for most
    verdicts that is the diverging event itself. ``before_a``/``before_b``
    are the last events before it in each run, ``same_node_*`` the last ones in the same node.
    ``settings`` are those of the settings that differ which can be the cause, ``likely_cause`` what
    came from outside and explains it ("" if nothing is known).
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
    settings: tuple[Setting, ...] = ()
    likely_cause: str = ""
