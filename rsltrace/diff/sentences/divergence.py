"""What is said of a divergence: what happened, why, what is likely behind it, and the headline."""

from __future__ import annotations

from dataclasses import replace

from rsltrace.diff.facts.causes import (
    NO_CALLBACKS,
    CallbackAbsence,
    CauseKind,
    Consequence,
    DifferentDraw,
    DifferentInput,
    DifferentOrder,
    DifferentOutput,
    DifferentSenders,
    DifferentTime,
    DivergenceKind,
    EarlierEnd,
    ErrorInTransition,
    EventInOneRun,
    ExceptionInOneRun,
    ExternalAnswers,
    Judgement,
    NoEarlierDifference,
    NoEventsLeft,
    NoMoreMessages,
    NotDelivered,
    QueueOverflow,
    RunEnd,
    SameCause,
    SetOrder,
    SleepTimes,
    UnfinishedCall,
    UnguardedCall,
    UnrecordedAnswer,
    WaitInOneRun,
)
from rsltrace.diff.facts.evidence import (
    CallDifference,
    EntityChange,
    EntityChanges,
    EntityProperty,
    EventSummary,
    Presence,
)
from rsltrace.diff.sentences import SENTENCES, says, sentence
from rsltrace.diff.sentences.values import (
    IN_ONE,
    NAMED_MAX,
    a_first,
    because_of,
    durations,
    field_text,
    joined,
    listed,
    pair_text,
    state_text,
    what_differs,
)
from rsltrace.trace.model.event import (
    NO_EVENT,
    EventFlag,
    EventKind,
    OutputKind,
    RandomDecision,
    decision_duration,
    decision_kind,
    decision_text,
    is_switch,
)
from rsltrace.trace.model.finding import NondeterminismSource
from rsltrace.trace.model.texts import (
    contrasting,
    contrasting_durations,
    format_duration,
    printable,
    shortened,
)
from rsltrace.trace.words.phrases import at_time, event_phrase, seconds_text

_WAITS_MAX = 160


def phrase(view: EventSummary) -> str:
    """Return what ran, as part of a sentence: ``subscription /scan of /filter``."""
    return event_phrase(view.kind, view.entity)


def _at(view: EventSummary) -> str:
    return f"{phrase(view)} {at_time(view.stamp_ns)}"


def _both(of: Judgement) -> tuple[EventSummary, EventSummary]:
    assert of.a is not None
    assert of.b is not None
    return of.a, of.b


def _one(of: Judgement) -> EventSummary:
    assert of.one is not None
    return of.one


def _has(of: Judgement) -> tuple[str, str]:
    """Return the run that has the event, and the one that has it not."""
    return ("a", "b") if of.b is None else ("b", "a")


_LOOKED_FOR = ("os.stat(", "os.lstat(")
"""Calls that are findings only where there is such a file."""

_THREAD = NondeterminismSource.THREAD.value


# -- what happened ---------------------------------------------------------------------------------


def sentence_of(of: Judgement) -> str:
    """Return what happened, and what is likely behind it."""
    text = sentence(of.what, of)
    if of.node_diverged:
        text += ", because its node had already diverged"
    if isinstance(of.what, EntityChanges):
        text = f"the graphs differ: {text}"
    if isinstance(of.likely, UnrecordedAnswer):
        return f"{text}; possible cause: {sentence(of.likely)}, which {_unrecorded(of.likely)}"
    if isinstance(of.likely, UnguardedCall):
        call = sentence(of.likely)
        return f"{text}; possible cause: {call}, which {of.likely.permission} lets differ"
    return f"{text}; likely cause: {sentence(of.likely)}" if of.likely is not None else text


def _unrecorded(answer: UnrecordedAnswer) -> str:
    return "comes in real time" if answer.source == _THREAD else "is not recorded"


@says(DivergenceKind.CONSTRUCTED_IN_ONE)
def _(what: DivergenceKind, of: Judgement) -> str:
    has, has_not = _has(of)
    name = _one(of).entity.name or "a part of the run"
    return f"the graphs differ: {name} is constructed in {has} but not in {has_not}"


@says(DivergenceKind.CONSTRUCTION_ORDER)
def _(what: DivergenceKind, of: Judgement) -> str:
    a, b = _both(of)
    firsts = f": {a.entity.name} first in a, {b.entity.name} in b" if a.entity != b.entity else ""
    return f"the nodes are constructed in a different order{firsts}"


@says(DivergenceKind.NODE_RENAMED)
def _(what: DivergenceKind, of: Judgement) -> str:
    a, b = _both(of)
    return f"the graphs differ: {a.entity.name} in a is renamed to {b.entity.name} in b"


@says(DivergenceKind.OTHER_ENTITIES)
def _(what: DivergenceKind, of: Judgement) -> str:
    changed = a_first([m for m in of.messages if m.kind is OutputKind.ENTITY])
    types: dict[str, list[str]] = {}
    for m in changed:
        types.setdefault(m.topic, []).append(m.type)
    things = [
        f"{m.topic} of type {m.type} {IN_ONE[m.presence]}"
        if m.presence in IN_ONE and len({*types[m.topic]}) > 1
        else f"{m.topic} {IN_ONE.get(m.presence, 'differs')}"
        for m in changed
    ]
    return f"the graphs differ: {phrase(_one(of))} created different entities ({listed(things)})"


@says(DivergenceKind.OTHER_CONSTRUCTION, DivergenceKind.OTHER_CONSTRUCTION_SAME_JOB)
def _(what: DivergenceKind, of: Judgement) -> str:
    text = f"{phrase(_one(of))} {_did(of)}"
    same = what is DivergenceKind.OTHER_CONSTRUCTION_SAME_JOB
    return f"{text}, in the same job and environment" if same else text


@says(DifferentOrder)
def _(what: DifferentOrder, of: Judgement) -> str:
    text = f"{at_time(what.event.stamp_ns)} the same events ran in a different order"
    if of.a is None or of.b is None:
        return text
    if of.a.entity == of.b.entity:
        return f"{text}: {phrase(what.event)} received two inputs in swapped order"
    return f"{text}: {phrase(of.a)} ran first in a, {phrase(of.b)} in b"


@says(EventInOneRun)
def _(what: EventInOneRun, of: Judgement) -> str:
    has, has_not = _has(of)
    text = f"{_at(_one(of))} is only in {has}"
    if what.loss is not None:
        return f"{text}: {sentence(what.loss)}"
    if what.periods_ns is not None:
        return f"{text}: timer period {durations(*what.periods_ns)}"
    if what.instead is not None:
        return f"{text}; the next event in {has_not} is {_at(what.instead)}"
    return text


@says(ExceptionInOneRun)
def _(what: ExceptionInOneRun, of: Judgement) -> str:
    a, _ = _both(of)
    when = ", after shutting down its context" if what.after_shutdown else ""
    error = f": {what.error}" if what.error else ""
    return f"{_received(a)} raised an exception only in {'a' if a.raised else 'b'}{when}{error}"


@says(DifferentTime)
def _(what: DifferentTime, of: Judgement) -> str:
    a, b = _both(of)
    if a.stamp_ns == b.stamp_ns:
        return f"{_at(a)} was due at different times in a and b"
    text = f"{phrase(a)} ran {_times(a, b)}"
    if what.periods_ns is not None:
        return f"{text}: timer period {durations(*what.periods_ns)}"
    return f"{text}: it {slept_text(what.slept)}" if what.slept is not None else text


def _times(a: EventSummary, b: EventSummary) -> str:
    late_ns = b.stamp_ns - a.stamp_ns
    late = "later" if late_ns > 0 else "earlier"
    late += " in simulated time" if a.stamp_ns.start_ns != b.stamp_ns.start_ns else ""
    times = f"{at_time(a.stamp_ns)} in a and {at_time(b.stamp_ns)} in b"
    return f"{times}, {format_duration(abs(late_ns))} {late}"


def slept_text(slept: SleepTimes) -> str:
    """Return ``slept 7 ms in b but not in a``."""
    if slept.a is not None and slept.b is not None:
        in_a, in_b = contrasting_durations(slept.a, slept.b)
        return f"slept {in_a} in a and {in_b} in b"
    if slept.a is not None:
        return f"slept {format_duration(slept.a)} in a but not in b"
    return f"slept {format_duration(slept.b or 0)} in b but not in a"


@says(DivergenceKind.BAG_MESSAGES_SWAPPED)
def _(what: DivergenceKind, of: Judgement) -> str:
    a, b = _both(of)
    early, late = sorted((a.stamp_ns, b.stamp_ns))
    return f"the bag's messages on {a.entity.name} {at_time(early)} and {at_time(late)} are swapped"


@says(DivergenceKind.BAG_MESSAGE_MOVED)
def _(what: DivergenceKind, of: Judgement) -> str:
    a, b = _both(of)
    return f"{phrase(a)} was played {_times(a, b)}"


@says(DivergenceKind.OTHER_BAG_MESSAGE)
def _(what: DivergenceKind, of: Judgement) -> str:
    values = next((field_text(m.fields, m.more_fields) for m in of.messages), "")
    return f"{_at(_one(of))} is different{f' ({values})' if values else ''}"


@says(DivergenceKind.ONLY_ZERO_DELAYS)
def _(what: DivergenceKind, of: Judgement) -> str:
    return f"one run only adds delays of 0 ns, first in {_at(_one(of))}"


@says(DivergenceKind.OTHER_SENDER)
def _(what: DivergenceKind, of: Judgement) -> str:
    a, b = _both(of)
    text = f"{_at(a)} received equal inputs from different "
    if a.cause_event == b.cause_event:
        return f"{text}outputs of {_event(a.cause_event)}"
    return f"{text}events: {_event(a.cause_event)} in a, {_event(b.cause_event)} in b"


def _event(index: int) -> str:
    return "no event" if index == NO_EVENT else f"event {index}"


_DRAWS: dict[RandomDecision | None, str] = {
    RandomDecision.DELAY: "delay",
    RandomDecision.DUPLICATE: "second copy",
    RandomDecision.EXECUTION: "execution time",
    RandomDecision.CLOCK_AHEAD: "change",
    RandomDecision.CLOCK_BACK: "change",
}


@says(DifferentDraw)
def _(what: DifferentDraw, of: Judgement) -> str:
    m = what.message
    same = "read a clock" if what.of_clock else "did the same in both runs"
    if not what.connected:
        drawn = f"its output reaches {m.topic} {IN_ONE[m.presence]}"
    elif what.of_event and not what.of_clock:
        took = (_took(m.hash_a, m.hash_b), _took(m.hash_b, m.hash_a))
        drawn = "took {} in a and {} in b".format(*took)
    else:
        drawn = f"{m.topic}: {_drawn(m.hash_a, m.hash_b)} in a, {_drawn(m.hash_b, m.hash_a)} in b"
    random = what.connected and (not of.settings or any(s.key == "seed" for s in of.settings))
    chance = "its random draws differ: " if random else ""
    text = f"{_at(_one(of))} {same}, but {chance}{drawn}"
    return f"{text} (and {what.more} more)" if what.more else text


def _drawn(number: int | None, other: int | None) -> str:
    """Return a decision in words, in which it differs from the other."""
    if number is None:
        return f"no {_DRAWS.get(decision_kind(other or 0), 'loss')}"
    return contrasting(number, number if other is None else other, decision_text)[0]


def _took(number: int | None, other: int | None) -> str:
    if number is None:
        return "no time"
    took_ns = decision_duration(number, RandomDecision.EXECUTION)
    if took_ns is None:
        return _drawn(number, other)
    other_ns = decision_duration(other, RandomDecision.EXECUTION) if other is not None else None
    return contrasting_durations(took_ns, took_ns if other_ns is None else other_ns)[0]


@says(DivergenceKind.THREAD_SWITCHED)
def _(what: DivergenceKind, of: Judgement) -> str:
    met = next(m for m in of.messages if is_switch(m.hash_a or 0) or is_switch(m.hash_b or 0))
    in_a, in_b = (is_switch(number or 0) for number in (met.hash_a, met.hash_b))
    places = met.code or ("an unknown line",)
    gave = f"{_at(_one(of))} switched to another thread before {places[0]}"
    if in_a and in_b:
        return f"{gave} in a, before {places[-1]} in b"
    one, other = ("a", "b") if in_a else ("b", "a")
    return f"{gave} in {one} but not in {other}"


@says(DifferentOutput)
def _(what: DifferentOutput, of: Judgement) -> str:
    one, differs = _one(of), what_differs(of.messages)
    if what.slept is not None and what.only_slept:
        text = f"{_at(one)} {slept_text(what.slept)}{differs}"
    else:
        text = f"{_received(one)} {_did(of)}"
        text += f", and {slept_text(what.slept)}" if what.slept is not None else ""
    return text


@says(DivergenceKind.OTHER_STATE)
def _(what: DivergenceKind, of: Judgement) -> str:
    left = "sent the same outputs, but left its node in a different state"
    return f"{_received(_one(of), 'and')} {left}{state_text(of.state)}"


def _received(one: EventSummary, joint: str = "but") -> str:
    """Return ``/filter: the callback for /scan at 2.1 s received the same input in both runs but``,
    as far as it received something."""
    who = _at(one)
    if one.kind in _CALLED_FOR and one.entity.node and not one.entity.ordinal:
        who = f"{one.entity.node}: the callback for {one.entity.name} {at_time(one.stamp_ns)}"
    return f"{who} received the same input in both runs {joint}" if one.input_hash else who


_CALLED_FOR = (EventKind.SUBSCRIPTION, EventKind.SERVICE)


def _did(of: Judgement) -> str:
    """Return what a callback did: ``published a different /push (data 1 → 2)``."""
    outputs = [message for message in of.messages if not message.is_input]
    if len(outputs) == 1 and outputs[0].kind is OutputKind.MESSAGE:
        (one,) = outputs
        if one.presence is Presence.BOTH and one.fate is None:
            values = field_text(one.fields, one.more_fields)
            return f"published a different {one.topic}{f' ({values})' if values else ''}"
        if one.fate is None:
            return f"published {one.topic} {IN_ONE[one.presence]}"
    if not outputs and of.a is not None and of.b is not None:
        a, b = (bool(one.flags & EventFlag.SUSPENDED) for one in (of.a, of.b))
        if a is not b:
            return f"waited only in {'a' if a else 'b'}"
    return f"behaved differently{what_differs(of.messages)}"


@says(EarlierEnd)
def _(what: EarlierEnd, of: Judgement) -> str:
    over, other = what.over, what.other
    where = f" {at_time(over.end_ns)}" if over.has_events else ""
    how = f"ended{where} ({over.reason})"
    if over.stuck:
        how = f"got stuck{where} ({shortened(over.stuck, _WAITS_MAX)})"
    return (
        f"run {over.run} {how}; {other.run} was identical until then and continued to "
        f"{seconds_text(other.end_ns)} s ({other.reason})"
    )


# -- entities with other properties ---------------------------------------------------------------


@says(EntityChanges)
def _(fact: EntityChanges, of: object) -> str:
    alike: dict[EntityChange, list[str]] = {}
    for change in fact.changes:
        node = replace(change.entity, kind="", name="", type="", ordinal=0)
        named = f"{change.entity.kind} {printable(change.entity.name)}"
        alike.setdefault(replace(change, entity=node), []).append(named)
    return joined([_change_text(change, joined(names)) for change, names in alike.items()])


def _change_text(change: EntityChange, names: str) -> str:
    values = ", ".join(_property_text(*value) for value in change.values)
    made = f"{change.entity.node} created {names}"
    text = f"{made} with a different {change.property.value}: {values}"
    if not change.peers:
        return text
    if change.property is EntityProperty.QOS:
        peers = joined([f"the {peer.kind} of {peer.node}" for peer in change.peers])
        return f"{text}, which in {change.run} does not match {peers}"
    peers = joined([f"{peer.kind} {printable(peer.name)}" for peer in change.peers])
    return f"{text}, in {change.run} that of {peers}"


def _property_text(name: str, a: str | int | None, b: str | int | None) -> str:
    word = f"{name.removesuffix('_ns')} " if name else ""
    if isinstance(a, int) and isinstance(b, int) and name.endswith("_ns"):
        return f"{word}{durations(a, b)}"
    one, other = (_policy(name, value) for value in (a, b))
    return f"{word}{pair_text(one, other)}"


def _policy(name: str, value: str | int | None) -> str:
    if value is None:  # a trace has only what is no default
        return "automatic" if name == "liveliness" else "none"
    return format_duration(value) if isinstance(value, int) and name.endswith("_ns") else f"{value}"


# -- what became of a message ----------------------------------------------------------------------


@says(QueueOverflow)
def _(loss: QueueOverflow, of: object) -> str:
    a, b = loss.depths
    depth = f"{loss.depth}" if a is None or b is None or a == b else f"{a} → {b}"
    return f"its queue (depth {depth}) overflowed in {loss.run}"


@says(UnfinishedCall)
def _(loss: UnfinishedCall, of: object) -> str:
    since = seconds_text(loss.since_ns)
    return f"{shortened(loss.text, _WAITS_MAX)}, from {since} s to the end of {loss.run}"


@says(CallbackAbsence)
def _(absence: CallbackAbsence, of: object) -> str:
    return f"{absence.words} ({absence.place})" if absence.place else absence.words


def no_event_text(absence: CallbackAbsence | None) -> str:
    """Return what stands for an event in a run that has none."""
    return "no such event" if absence is None else f"no such event: {sentence(absence)}"


# -- why -------------------------------------------------------------------------------------------


def cause_of(of: Judgement) -> str:
    """Return where it comes from, and how one of the runs failed; "" if there is nothing to say."""
    if of.why is None:
        return ""
    text = sentence(of.why, of)
    if isinstance(of.likely, UnrecordedAnswer):
        source = of.likely.source
        is_kept = source not in ("", _THREAD)
        how = f" (to record it, set guard: {{{source}: record}} in the job)" if is_kept else ""
        text = f"{text}; {sentence(of.likely)} {_unrecorded(of.likely)}{how}"
    elif isinstance(of.likely, UnguardedCall):
        count = of.likely.more
        more = f" and {count} more call{'s' if count > 1 else ''}" if count else ""
        permission = f", which {of.likely.permission} lets differ"
        text = f"{text}; a possible cause is {sentence(of.likely)}{more}{permission}"
    elif isinstance(of.likely, ErrorInTransition):
        text = f"{sentence(of.likely)}; {text}"
    elif of.likely is not None:
        because = because_of(of.settings)
        text = f"{sentence(of.likely)}; and {because}" if because else sentence(of.likely)
    return f"{text}; {failure_text(of.failed)}" if of.failed is not None else text


def failure_text(failed: RunEnd) -> str:
    """Say how a run failed where the other did not."""
    verb = "failed" if failed.error or failed.raised else "ended"
    why = failed.error or failed.reason
    return f"{failed.run} then {verb} (exit code {failed.exit_code}): {why}"


_REASONS = {
    CauseKind.DRIVEN_DIFFERENTLY: "the code that drives the simulation acted differently",
    CauseKind.BAGS_SWAPPED: "the played bags have these two messages in a different order",
    CauseKind.BAGS_AT_OTHER_TIMES: "the played bags have this message at different times",
    CauseKind.BAGS_DIFFER: "the played bags differ in this message",
    CauseKind.OTHER_CONTENT_ARRIVED: "the same message was sent, but different content arrived",
    CauseKind.SENDER_UNKNOWN: "the trace does not say where it came from",
    CauseKind.DELAY_IN_ONE: "only one of the runs delays what it sent",
    CauseKind.EQUAL_MESSAGES_SWAPPED: "two equal messages were delivered in a different order",
    CauseKind.STREAM_MOVED: "job and seed are the same as far as the traces show, so the random "
    "stream of this link was used a different number of times before",
    CauseKind.POLICY_CHOSE: "the scheduling policy chose a different one of the ready callbacks",
}


@says(*_REASONS)
def _(why: CauseKind, of: Judgement) -> str:
    return because_of(of.settings) or _REASONS[why]


@says(CauseKind.CONSTRUCTOR)
def _(why: CauseKind, of: Judgement) -> str:
    which = "itself" if of.changed is None else f"of {of.changed.node}"
    return because_of(of.settings) or (
        f"job and environment are the same as far as the traces show: the constructor {which} is "
        "not deterministic, or its code changed"
    )


@says(CauseKind.READY_AT_ONCE)
def _(why: CauseKind, of: Judgement) -> str:
    if because := because_of(of.settings):
        return f"both callbacks were ready at the same simulated time, and {because}"
    return (
        "both callbacks were ready at the same simulated time, and the tie was broken differently "
        "(by order of creation, subscription or delivery)"
    )


@says(CauseKind.NOTHING_MADE_IT_RUN)
def _(why: CauseKind, of: Judgement) -> str:
    if because := because_of(of.settings):
        return f"no earlier event differs, but {because}"
    one = _one(of)
    has = _has(of)[0]
    text = f"no earlier event differs, and the trace does not show why it ran in {has}"
    who = f"the {one.entity.kind} itself" if one.entity.kind in NO_CALLBACKS else one.entity.node
    return f"{text}: {who} is not deterministic" if who else text


@says(CauseKind.NOT_CONNECTED)
def _(why: CauseKind, of: Judgement) -> str:
    assert isinstance(of.what, DifferentDraw)
    has_not = "a" if of.what.message.presence is Presence.ONLY_B else "b"
    topic = of.what.message.topic
    gone = f"in {has_not} {topic} receives nothing: it is gone or not connected"
    because = because_of(of.settings)
    return f"{gone}; {because}" if because else gone


@says(WaitInOneRun)
def _(why: WaitInOneRun, of: Judgement) -> str:
    has, has_not = _has(of)
    cause = f"{phrase(why.cause)} (event {why.cause.index})"
    doubt = because_of(of.settings) or f"{_itself(_one(of).entity.kind)} is not deterministic"
    return f"it waited for {cause} in {has} but not in {has_not}; {doubt}"


@says(NotDelivered)
def _(why: NotDelivered, of: Judgement) -> str:
    lost = f"arrived only in {_has(of)[0]}" if why.loss is None else sentence(why.loss)
    sent = f"sent in both runs (event {why.cause.index}, {phrase(why.cause)})"
    text = f"its input was {sent}, but {lost}"
    if because := because_of(of.settings):
        return f"{text}; {because}"
    if of.is_unexplained:
        who = _one(of).entity.node if of.changed is None else of.changed.node
        return f"{text}; {who} is not deterministic"
    return text


@says(NoEarlierDifference)
def _(why: NoEarlierDifference, of: Judgement) -> str:
    if because := because_of(of.settings):
        return f"no earlier event differs, but {because}"
    doubt = "what sets its time" if why.doubt == "time" else _itself(why.doubt)
    text = f"no earlier event differs: {doubt} is not deterministic"
    if why.state_unknown:
        text += (
            f", or the state of {_one(of).entity.node} already differed (to record it, set "
            "guard: {state: record} in the job)"
        )
    if why.guard_is_off:
        text += "; with guard: false, what it reads from outside is not recorded"
    return text


def _itself(kind: str) -> str:
    return f"the {kind if kind in NO_CALLBACKS else 'callback'} itself"


@says(CauseKind.CUT_OFF)
def _(why: CauseKind, of: Judgement) -> str:
    assert isinstance(of.what, EarlierEnd)
    return (
        f"the recording of {of.what.over.run} is truncated: the run was killed or is still going "
        "on, or the file is incomplete"
    )


@says(CauseKind.STOPS_DIFFER)
def _(why: CauseKind, of: Judgement) -> str:
    stops = "; ".join(f"{s.key}: {s.a or '-'} in a, {s.b or '-'} in b" for s in of.settings)
    return f"the runs are identical until then; their jobs set different stops: {stops}"


@says(NoEventsLeft)
def _(why: NoEventsLeft, of: Judgement) -> str:
    alone = why.alone
    missing = f"{sentence(alone.what, alone)}; {cause_of(alone)}"
    return f"{why.run} had nothing left to do: {missing}"


@says(CauseKind.ENDED)
def _(why: CauseKind, of: Judgement) -> str:
    assert isinstance(of.what, EarlierEnd)
    over = of.what.over
    if over.error:
        how = f"{over.run} failed (exit code {over.exit_code}): {over.error}"
    elif over.exit_code:
        how = f"{over.run} ended with exit code {over.exit_code} ({over.reason})"
    elif over.nothing_left:
        how = f"{over.run} had nothing left to do"
    else:
        how = f"{over.run} ended: {over.reason}"
    because = because_of(of.settings)
    return f"the runs are identical until then; {how}{f'; {because}' if because else ''}"


# -- what is likely behind it ----------------------------------------------------------------------

_CALLED = {
    NondeterminismSource.ENVIRONMENT: "read",
    NondeterminismSource.PID: "read",
    NondeterminismSource.FILE: "read",
    NondeterminismSource.DIRECTORY: "listed",
    NondeterminismSource.CLOCK: "read",
    NondeterminismSource.RANDOM: "drew",
    NondeterminismSource.SOCKET: "called",
}


@says(ExternalAnswers)
def _(cause: ExternalAnswers, of: object) -> str:
    who = cause.subject or "the run"
    texts = list(dict.fromkeys(call_text(call) for call in cause.calls))
    more = len(texts) - NAMED_MAX
    text = f"{who} {'; '.join(texts[:NAMED_MAX])}"
    return f"{text}; and {more} more" if more > 0 else text


def no_answer(call: CallDifference) -> str:
    """Return what stands for the answer in a run that has none."""
    return "not found or not called" if call.call.startswith(_LOOKED_FOR) else "not called"


def call_text(call: CallDifference) -> str:
    """Return ``read MOTOR_SEED (6 in a, 4 in b) at picker.py:24``."""
    done = f"{_CALLED.get(NondeterminismSource(call.source), 'called')} {printable(call.subject)}"
    place = call.where.partition(" in ")[0]
    at = f" at {place}" if place else ""
    if call.a is None or call.b is None:
        if call.call.startswith(_LOOKED_FOR):
            done = f"found {printable(call.subject)}"
        return f"{done} only in {'b' if call.a is None else 'a'}{at}"
    return f"{done} ({call.short[0]} in a, {call.short[1]} in b){at}"


@says(ErrorInTransition)
def _(cause: ErrorInTransition, of: object) -> str:
    raised = f"{cause.callback} of {cause.node} raised"
    if cause.a is not None and cause.b is not None:
        return f"{raised} {cause.a} in a, {cause.b} in b, at {cause.place}, which rclpy suppressed"
    where = "a" if cause.b is None else "b"
    return f"{raised} {cause.a or cause.b} at {cause.place} only in {where}; rclpy suppressed it"


@says(SetOrder)
def _(cause: SetOrder, of: object) -> str:
    more = f" (and {cause.more} more)" if cause.more else ""
    return f"the {cause.what} at {cause.place}{more}"


SENTENCES.update(
    {
        DivergenceKind.OTHER_FROM_OUTSIDE: lambda fact, of: f"{_at(_one(of))} is different",
        DivergenceKind.OTHER_DONE_OUTSIDE: lambda fact, of: (
            f"{_at(_one(of))} is different{what_differs(of.messages)}"
        ),
        DifferentInput: lambda fact, of: (
            f"{_at(_one(of))} received a different {fact.topic or 'input'}"
        ),
        NoMoreMessages: lambda fact, of: f"it receives nothing more in {fact.run}",
        CauseKind.ONLY_IN_ONE_BAG: lambda fact, of: (
            because_of(of.settings) or f"only the bag of {_has(of)[0]} has this message"
        ),
        CauseKind.DRIVEN_IN_ONE: lambda fact, of: (
            f"the code that drives the simulation did this only in {_has(of)[0]}"
        ),
        CauseKind.FAULT_IN_ONE: lambda fact, of: (
            because_of(of.settings) or f"only the job of {_has(of)[0]} has this fault"
        ),
        DifferentSenders: lambda fact, of: (
            f"in a it came from {phrase(fact.a)} (event {fact.a.index}), in b from "
            f"{phrase(fact.b)} (event {fact.b.index})"
        ),
        Consequence: lambda fact, of: (
            f"it follows from an earlier difference: {sentence(fact.root.what, fact.root)}"
        ),
        SameCause: lambda fact, of: cause_of(fact.first),
        UnguardedCall: lambda fact, of: f"{fact.call} at {fact.place}",
        UnrecordedAnswer: lambda fact, of: f"the result of {fact.call} at {fact.place}",
    }
)
