"""From two differing events to a verdict: what happened, and why.

The first rule in ``_judge`` that applies wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace

from rsltrace.diff.causes.propagation import NODE
from rsltrace.diff.causes.relevance import DivergenceSite, Relevance
from rsltrace.diff.facts.causes import (
    NO_CALLBACKS,
    CauseFact,
    CauseKind,
    DifferentDraw,
    DifferentInput,
    DifferentOrder,
    DifferentOutput,
    DifferentSenders,
    DifferentTime,
    DivergenceFact,
    DivergenceKind,
    EventInOneRun,
    ExceptionInOneRun,
    Judgement,
    Loss,
    NoEarlierDifference,
    NotDelivered,
    Root,
    SleepTimes,
    Verdict,
    WaitInOneRun,
)
from rsltrace.diff.facts.evidence import (
    EntityChanges,
    EventSummary,
    MessageDifference,
    Presence,
    Setting,
    StateDifference,
    node_of,
)
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind, is_switch
from rsltrace.trace.model.operation import PARAMETER_EVENTS

_DRAWN_FROM = ("delay", "faults", "execution", "seed", "clocks")
"""Keys of a job that decide whether something is drawn."""
_OF_BAGS = ("bags", "faults", "start", "construct_time", "min_time_step")
"""Keys of a job that decide when a bag's message is played."""


@dataclass(frozen=True, slots=True)
class DivergenceCase:
    """What is known of a place where the runs differ.

    ``a`` and ``b`` are counterparts, or one of them is None. ``other_a`` and ``other_b`` are what
    the runs did at that place, which is something else if the event is not there, or came later.
    ``cause_a`` and ``cause_b`` are the events that caused them. ``why`` is None for a root.
    """

    a: EventSummary | None
    b: EventSummary | None
    other_a: EventSummary | None
    other_b: EventSummary | None
    cause_a: EventSummary | None
    cause_b: EventSummary | None
    inverted: bool
    cause_only: bool
    why: str | None
    messages: tuple[MessageDifference, ...]
    settings: Sequence[Setting]
    relevance: Relevance
    state: tuple[StateDifference, ...] = ()
    loss: Loss | None = None
    """What became of a message that only one run received, where that is known."""

    periods_ns: tuple[int, int] | None = None
    """Of a timer, its period in both runs, if they differ."""

    slept: SleepTimes | None = None
    """How long a callback slept, if that differs."""

    changed: EntityChanges | None = None
    """The entities whose QoS differs, of the topics that are concerned."""

    reordered: bool = False
    """Whether a main constructs another one of the nodes of both runs first."""

    swapped: bool = False
    """Whether the bag of b plays later what the bag of a plays here, and the other way round."""

    blamed: list[Setting] = field(default_factory=list)
    """The settings that ``blame`` found."""

    @property
    def one(self) -> EventSummary:
        """The event, of whichever run has it."""
        view = self.a or self.b
        assert view is not None
        return view

    def blame(self, *, inside: bool = False, drawn: bool = False) -> bool:
        """Find which settings differ that can be the cause; False if there are none."""
        views = [self.a, self.b]
        if not inside:
            views += [self.other_a, self.other_b, self.cause_a, self.cause_b]
        involved = [view for view in views if view is not None]
        nodes = {view.node for view in involved}
        mains = {v.entity.name for v in involved if v.entity.kind == EntityKind.MAIN.label}
        if any(map(_is_qos_event, self.messages)):
            nodes = set()  # which has made them is not known, but whose QoS has changed
        if self.changed is not None:
            nodes = set(self.changed.nodes)
        nodes |= {node_of(m.entity) for m in self.messages if m.kind is OutputKind.DRAW}
        constructing = self.one.kind is EventKind.CONSTRUCT or any(
            m.kind is OutputKind.ENTITY or m.topic == PARAMETER_EVENTS for m in self.messages
        )
        settings = self.settings
        if self.one.kind is EventKind.BAG and not drawn:
            settings = [setting for setting in settings if setting.part in _OF_BAGS]
        place = DivergenceSite(
            frozenset(nodes - {""}), constructing, inside, drawn, frozenset(mains)
        )
        self.blamed[:] = self.relevance.of(settings, place)
        return bool(self.blamed)

    def judgement(
        self,
        verdict: Verdict,
        root: Root,
        what: DivergenceFact,
        why: CauseFact | None,
        events: tuple[EventSummary | None, EventSummary | None] | None = None,
    ) -> Judgement:
        """Return a verdict, on the two events or on others."""
        a, b = (self.a, self.b) if events is None else events
        return Judgement(verdict, root, what, why, a, b, self.messages, self.state)


ROOT_OF = {
    Verdict.SAME_INPUT_DIFFERENT_OUTPUT: Root.CALLBACK,
    Verdict.SCHEDULE: Root.SCHEDULE,
    Verdict.TIMING: Root.TIMING,
    Verdict.MISSING: Root.MISSING,
    Verdict.EXTRA: Root.EXTRA,
    Verdict.EXCEPTION: Root.EXCEPTION,
    Verdict.DRAW: Root.DRAW,
    Verdict.GRAPH: Root.JOB,
    Verdict.ENVIRONMENT: Root.JOB,
}


def judge(case: DivergenceCase) -> Judgement:
    """Return the verdict on a place where the runs differ."""
    judgement = _judge(case)
    return replace(judgement, settings=tuple(case.blamed))


def _judge(case: DivergenceCase) -> Judgement:
    a, b, one = case.a, case.b, case.one
    if one.kind is EventKind.CONSTRUCT and not (a and b and a.raised != b.raised):
        return _construction(case)
    if case.inverted:
        return _schedule(case)
    if a is None or b is None:
        return _one_sided(case)
    if a.raised != b.raised and a.input_hash == b.input_hash:
        return _exception(case, a)
    if a.stamp_ns != b.stamp_ns or (a.kind is EventKind.TIMER and a.input_hash != b.input_hash):
        return _timing(case, a)
    if a.input_hash != b.input_hash:
        return _different_input(case, a, b)
    if case.cause_only:
        return _another_cause(case, a, b)
    draws = [m for m in case.messages if m.kind is OutputKind.DRAW]
    if any(is_switch(m.hash_a or 0) or is_switch(m.hash_b or 0) for m in draws):
        case.blame()
        return case.judgement(
            Verdict.SCHEDULE, Root.SCHEDULE, DivergenceKind.THREAD_SWITCHED, CauseKind.POLICY_CHOSE
        )
    if draws and all(m.kind is OutputKind.DRAW for m in case.messages):
        return _draw(case, a, draws)
    if draws and draws[0] is case.messages[0] and _is_of_clock(draws[0]):
        return _draw(case, a, draws)  # what was done with the time that was read is different
    return _same_input(case, a, b)


# -- the verdicts ----------------------------------------------------------------------------------


def _construction(case: DivergenceCase) -> Judgement:
    a, b = case.a, case.b
    explained = case.blame()
    verdict, root = Verdict.GRAPH, Root.JOB if explained else Root.CALLBACK
    what: DivergenceFact
    if a is None or b is None:
        root, what = Root.JOB, DivergenceKind.CONSTRUCTED_IN_ONE
    elif case.inverted or case.reordered:
        what = DivergenceKind.CONSTRUCTION_ORDER
    elif a.entity != b.entity:
        what = DivergenceKind.NODE_RENAMED
    elif a.stamp_ns != b.stamp_ns and all(map(_is_stamp_of_parameters, case.messages)):
        return _timing(case, a)
    elif case.changed is not None:
        what = case.changed
    elif any(m.kind is OutputKind.ENTITY for m in case.messages):
        what = DivergenceKind.OTHER_ENTITIES
    elif explained:
        verdict, what = Verdict.ENVIRONMENT, DivergenceKind.OTHER_CONSTRUCTION
    else:
        verdict, root = Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK
        what = DivergenceKind.OTHER_CONSTRUCTION_SAME_JOB
    return case.judgement(verdict, root, what, CauseKind.CONSTRUCTOR)


def _is_stamp_of_parameters(message: MessageDifference) -> bool:
    """Whether parameters that are the same were declared at another time."""
    paths = [field.path for field in message.fields]
    return message.topic == PARAMETER_EVENTS and paths == ["stamp"] and not message.more_fields


def _schedule(case: DivergenceCase) -> Judgement:
    case.blame()
    what, events = DifferentOrder(case.one), (case.other_a, case.other_b)
    return case.judgement(Verdict.SCHEDULE, Root.SCHEDULE, what, CauseKind.READY_AT_ONCE, events)


def _one_sided(case: DivergenceCase) -> Judgement:
    one, a = case.one, case.a
    verdict, root = (Verdict.MISSING, Root.MISSING) if a else (Verdict.EXTRA, Root.EXTRA)
    what = EventInOneRun(case.other_b if a else case.other_a, case.loss, case.periods_ns)
    cause = case.cause_a if a else case.cause_b
    why: CauseFact | None
    if case.why is not None:
        why = None
    elif cause is not None and one.kind is EventKind.RESUME:
        why = WaitInOneRun(cause)
    elif cause is not None:
        why = NotDelivered(cause, case.loss)
    else:
        why = _FROM_OUTSIDE.get(one.kind, CauseKind.NOTHING_MADE_IT_RUN)
    if why not in (None, CauseKind.DRIVEN_IN_ONE):
        case.blame()
    return case.judgement(verdict, root, what, why)


_FROM_OUTSIDE = {
    EventKind.BAG: CauseKind.ONLY_IN_ONE_BAG,
    EventKind.OUTSIDE: CauseKind.DRIVEN_IN_ONE,
    EventKind.FAULT: CauseKind.FAULT_IN_ONE,
}


def _exception(case: DivergenceCase, a: EventSummary) -> Judgement:
    error = next((m.preview for m in case.messages if m.kind is OutputKind.EXCEPTION), "")
    where = Presence.ONLY_A if a.raised else Presence.ONLY_B
    after_shutdown = any(
        m.kind is OutputKind.SHUTDOWN and m.presence is where for m in case.messages
    )
    what, why = ExceptionInOneRun(error, after_shutdown), _hidden(case, _doubt(a), inside=True)
    return case.judgement(Verdict.EXCEPTION, Root.EXCEPTION, what, why)


def _timing(case: DivergenceCase, a: EventSummary) -> Judgement:
    if a.kind is EventKind.BAG:  # a bag decides on the time of its messages, and nothing else does
        case.blame()
        what = (
            DivergenceKind.BAG_MESSAGES_SWAPPED
            if case.swapped
            else DivergenceKind.BAG_MESSAGE_MOVED
        )
        why = CauseKind.BAGS_SWAPPED if case.swapped else CauseKind.BAGS_AT_OTHER_TIMES
        return case.judgement(Verdict.TIMING, Root.EXTERNAL_INPUT, what, why)
    moved = DifferentTime(case.periods_ns, case.slept)
    return case.judgement(Verdict.TIMING, Root.TIMING, moved, _hidden(case, "time"))


def _different_input(case: DivergenceCase, a: EventSummary, b: EventSummary) -> Judgement:
    what: DivergenceFact
    why: CauseFact
    root = Root.EXTERNAL_INPUT
    if a.kind is EventKind.BAG:
        case.blame()
        what, why = DivergenceKind.OTHER_BAG_MESSAGE, CauseKind.BAGS_DIFFER
    elif a.kind is EventKind.OUTSIDE:
        what, why = DivergenceKind.OTHER_FROM_OUTSIDE, CauseKind.DRIVEN_DIFFERENTLY
    else:
        root = Root.UNKNOWN
        what = DifferentInput(next((m.topic for m in case.messages if m.is_input and m.topic), ""))
        if case.cause_a is None or case.cause_b is None:
            why = CauseKind.SENDER_UNKNOWN
        elif (a.cause_event, a.cause_output) == (b.cause_event, b.cause_output):
            why = CauseKind.OTHER_CONTENT_ARRIVED
        else:
            why = DifferentSenders(case.cause_a, case.cause_b)
    return case.judgement(Verdict.DIFFERENT_INPUT, root, what, why)


def _another_cause(case: DivergenceCase, a: EventSummary, b: EventSummary) -> Judgement:
    if a.cause_event == b.cause_event and a.output_hash != b.output_hash:
        case.blame(drawn=True)
        what, reason = DivergenceKind.ONLY_ZERO_DELAYS, CauseKind.DELAY_IN_ONE
        return case.judgement(Verdict.DRAW, Root.DRAW, what, reason)
    what, reason = DivergenceKind.OTHER_SENDER, CauseKind.EQUAL_MESSAGES_SWAPPED
    return case.judgement(Verdict.SCHEDULE, Root.SCHEDULE, what, reason)


def _draw(case: DivergenceCase, a: EventSummary, draws: Sequence[MessageDifference]) -> Judgement:
    first = draws[0]
    case.blame(drawn=True)
    is_clock = _is_of_clock(first)
    of_delays = any(setting.part in _DRAWN_FROM for setting in case.blamed)
    what = DifferentDraw(
        first,
        more=len(draws) - 1,
        of_clock=is_clock,
        of_event=first.entity == a.entity,
        connected=first.presence is Presence.BOTH or is_clock or of_delays,
    )
    why = CauseKind.STREAM_MOVED if what.connected else CauseKind.NOT_CONNECTED
    return case.judgement(Verdict.DRAW, Root.DRAW, what, why)


def _same_input(case: DivergenceCase, a: EventSummary, b: EventSummary) -> Judgement:
    if a.kind is EventKind.OUTSIDE:
        done, driven = DivergenceKind.OTHER_DONE_OUTSIDE, CauseKind.DRIVEN_DIFFERENTLY
        return case.judgement(Verdict.DIFFERENT_INPUT, Root.EXTERNAL_INPUT, done, driven)
    what: DivergenceFact
    if a.output_hash == b.output_hash and a.state_hash != b.state_hash:
        what = DivergenceKind.OTHER_STATE
    else:
        others = [m for m in case.messages if not _is_qos_event(m)]
        if case.changed is not None and not others:
            explained = case.blame()
            root = Root.JOB if explained else Root.CALLBACK
            return case.judgement(Verdict.GRAPH, root, case.changed, CauseKind.CONSTRUCTOR)
        only_slept = all(message.fate is not None for message in case.messages)
        what = DifferentOutput(case.slept, only_slept=case.slept is not None and only_slept)
    suspended = EventFlag.SUSPENDED in a.flags | b.flags
    why = _hidden(case, _doubt(a), inside=not suspended)
    return case.judgement(Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK, what, why)


# -- what they rest on -----------------------------------------------------------------------------


def _hidden(
    case: DivergenceCase, doubt: str, *, inside: bool = False
) -> NoEarlierDifference | None:
    """Return what a root means: nothing that the trace shows differs before it."""
    if case.why == NODE:
        return None
    case.blame(inside=inside)
    node = case.one.entity.node
    state_unknown = case.relevance.is_of_a_class(node) and not case.one.state_hash
    return NoEarlierDifference(doubt, state_unknown, case.relevance.guard_is_off)


def _doubt(view: EventSummary) -> str:
    return view.entity.kind if view.entity.kind in NO_CALLBACKS else "callback"


def _is_of_clock(message: MessageDifference) -> bool:
    return message.kind is OutputKind.DRAW and message.entity.kind == EntityKind.NODE.label


def _is_qos_event(message: MessageDifference) -> bool:
    is_new = message.kind is OutputKind.ENTITY
    return is_new and message.entity.kind == EntityKind.QOS_EVENT.label
