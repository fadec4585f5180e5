"""From two differing events to a verdict, and to the sentences that say it.

The rules stand in the order in which they are asked: what is seen first in ``_judge`` wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from rsltrace.diff.causes.effects import PARAMETER_EVENTS
from rsltrace.diff.causes.event_views import CLOCK_OF, drawn_for, node_of, phrase, raised
from rsltrace.diff.causes.lost_messages import GONE, OTHER_QOS
from rsltrace.diff.causes.output_notes import durations
from rsltrace.diff.causes.propagation import NODE
from rsltrace.diff.causes.relevance import Place, Relevance
from rsltrace.diff.causes.wording import (
    a_first,
    because_of,
    field_text,
    listed,
    state_text,
    what_differs,
)
from rsltrace.diff.result.divergence import MessageDifference, StateDifference
from rsltrace.diff.result.events import EventView
from rsltrace.diff.result.settings import Setting
from rsltrace.diff.result.verdicts import Root, Verdict
from rsltrace.model.draw import is_switch
from rsltrace.model.entity import EntityKind
from rsltrace.model.event import NO_EVENT, EventFlag, EventKind, OutputKind
from rsltrace.model.stamp import format_duration
from rsltrace.words.phrases import at_time

_NO_DRAW = "none"
_QOS_EVENT = "new qos event "
_NO_CALLBACKS = (EntityKind.MAIN.label, EntityKind.THREAD.label)
_DRAWN_FROM = ("delay", "faults", "execution", "seed", "clocks")
"""Keys of a job that decide whether something is drawn."""
_OF_BAGS = ("bags", "faults", "start", "construct_time", "min_time_step")
"""Keys of a job that decide when a bag's message is played."""


@dataclass(frozen=True, slots=True)
class Case:
    """What is known of a place where the runs differ.

    ``a`` and ``b`` are counterparts, or one of them is None. ``other_a`` and ``other_b`` are what
    the runs did at that place, which is something else if the event is not there, or came later.
    ``cause_a`` and ``cause_b`` are the events that caused them. ``why`` is None for a root.
    """

    a: EventView | None
    b: EventView | None
    other_a: EventView | None
    other_b: EventView | None
    cause_a: EventView | None
    cause_b: EventView | None
    inverted: bool
    cause_only: bool
    why: str | None
    messages: Sequence[MessageDifference]
    settings: Sequence[Setting]
    relevance: Relevance
    state: Sequence[StateDifference] = ()
    lost: str = ""
    """What became of a message that only one run received, where that is known."""

    periods: tuple[int, int] | None = None
    """Of a timer, its period in both runs (ns), if they differ."""

    slept: str = ""
    """How long a callback slept, if that differs."""

    swapped_with_ns: int | None = None
    """When the bag of b plays what the bag of a plays here, and the other way round."""

    blamed: list[Setting] = field(default_factory=list)
    """The settings that ``because`` named."""

    @property
    def one(self) -> EventView:
        """The event, of whichever run has it."""
        view = self.a or self.b
        assert view is not None
        return view

    def because(self, *, inside: bool = False, drawn: bool = False) -> str:
        """Say which settings differ that can be the cause, "" if there are none."""
        views = (self.a, self.b, self.other_a, self.other_b, self.cause_a, self.cause_b)
        nodes = {node_of(view) for view in views if view is not None}
        if any(m.topic.startswith(_QOS_EVENT) for m in self.messages):
            nodes = set()  # whose QoS has changed is not known
        nodes |= {m.topic.rpartition(" of ")[2] for m in self.messages if _is_draw(m)}
        constructing = self.one.kind is EventKind.CONSTRUCT or any(
            m.kind is OutputKind.ENTITY or m.topic == PARAMETER_EVENTS for m in self.messages
        )
        settings = self.settings
        if self.one.kind is EventKind.BAG and not drawn:
            settings = [s for s in settings if s.key.partition(".")[0] in _OF_BAGS]
        place = Place(frozenset(nodes - {""}), constructing, inside, drawn)
        self.blamed[:] = self.relevance.of(settings, place)
        return because_of(self.blamed)


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict in words. ``a`` and ``b`` are the events to show, ``settings`` what it blames."""

    verdict: Verdict
    root: Root
    sentence: str
    root_sentence: str
    a: EventView | None
    b: EventView | None
    settings: tuple[Setting, ...] = ()
    likely_cause: str = ""
    """What came from outside and explains it, where that is known."""


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

_DRIVEN_DIFFERENTLY = "whoever drove the simulations did not do the same"


def judge(case: Case) -> Judgement:
    """Return the verdict on a place where the runs differ."""
    judgement = _judge(case)
    return replace(judgement, settings=tuple(case.blamed))


def _judge(case: Case) -> Judgement:
    a, b, one = case.a, case.b, case.one
    if one.kind is EventKind.CONSTRUCT and not (a and b and raised(a) != raised(b)):
        return _construction(case)
    if case.inverted:
        return _schedule(case)
    if a is None or b is None:
        return _one_sided(case)
    if raised(a) != raised(b) and a.input_hash == b.input_hash:
        return _exception(case, a, b)
    if a.stamp_ns != b.stamp_ns or (a.kind is EventKind.TIMER and a.input_hash != b.input_hash):
        return _timing(case, a, b)
    if a.input_hash != b.input_hash:
        return _different_input(case, a, b)
    if case.cause_only:
        return _another_cause(case, a, b)
    draws = [m for m in case.messages if m.kind is OutputKind.DRAW]
    switch = next((m for m in draws if is_switch(m.hash_a or 0) or is_switch(m.hash_b or 0)), None)
    if switch is not None:
        return _switch(case, a, b, switch)
    if draws and all(m.kind is OutputKind.DRAW for m in case.messages):
        return _draw(case, a, b, draws)
    if draws and draws[0] is case.messages[0] and draws[0].topic.startswith(CLOCK_OF):
        return _draw(case, a, b, draws)  # what was done with the time that was read is different
    return _same_input(case, a, b)


# -- the verdicts ----------------------------------------------------------------------------------


def _construction(case: Case) -> Judgement:
    a, b, one = case.a, case.b, case.one
    because = case.because()
    verdict, root = Verdict.GRAPH, Root.JOB if because else Root.CALLBACK
    if a is None or b is None:
        has, has_not = ("a", "b") if b is None else ("b", "a")
        name = one.entity.name or "a part of the run"
        sentence = f"the graphs differ: {name} is constructed in {has} and not in {has_not}"
        root = Root.JOB
    elif a.entity != b.entity:
        sentence = f"the graphs differ: {a.entity.name} in a is renamed to {b.entity.name} in b"
    elif case.inverted:
        sentence = "the nodes are constructed in another order"
    elif a.stamp_ns != b.stamp_ns and all(map(_is_stamp_of_parameters, case.messages)):
        return _timing(case, a, b)
    else:
        changed = a_first([m for m in case.messages if m.kind is OutputKind.ENTITY])
        if changed:
            where = {"only a": "only in a", "only b": "only in b"}
            types: dict[str, list[str]] = {}
            for m in changed:
                types.setdefault(m.topic, []).append(m.type)
            things = [
                f"{m.topic} of type {m.type} {where[m.presence]}"
                if m.presence in where and len({*types[m.topic]}) > 1
                else f"{m.topic} {where.get(m.presence, 'differs')}"
                for m in changed
            ]
            sentence = f"the graphs differ: {phrase(one)} made other entities ({listed(things)})"
            if any(m.topic.startswith(_QOS_EVENT) for m in changed):
                sentence += ", since QoS differs"
        elif because:
            verdict = Verdict.ENVIRONMENT
            sentence = f"{phrase(one)} did something else{what_differs(case.messages)}"
        else:
            verdict, root = Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Root.CALLBACK
            sentence = (
                f"{phrase(one)} did something else{what_differs(case.messages)}, in the same job "
                "and environment"
            )
    return Judgement(verdict, root, sentence, because or _why_constructed(case), a, b)


def _is_stamp_of_parameters(message: MessageDifference) -> bool:
    """Whether parameters that are the same were declared at another time."""
    paths = [field.path for field in message.fields]
    return message.topic == PARAMETER_EVENTS and paths == ["stamp"] and not message.more_fields


def _why_constructed(case: Case) -> str:
    """Say why a constructor may have done something else in the same job and environment."""
    parameters = [m.note for m in case.messages if m.topic == PARAMETER_EVENTS and m.note]
    files = case.relevance.parameter_files
    if parameters and files:
        return (
            f"parameter {listed(parameters)}: a parameter file ({listed(files)}) says something "
            "else, or the constructor does"
        )
    return (
        "job and environment are the same as far as the traces tell: the constructor itself is "
        "not deterministic, or its code changed"
    )


def _schedule(case: Case) -> Judgement:
    one = case.one
    first, second = case.other_a, case.other_b
    if first is None or second is None or first.entity == second.entity:
        sentence = f"{at_time(one.stamp_ns)} the same events ran in another order"
        if first is not None and second is not None:
            sentence += f": {phrase(one)} took two inputs the other way round"
    else:
        sentence = (
            f"{at_time(one.stamp_ns)} the same events ran in another order: "
            f"first {phrase(first)} in a, first {phrase(second)} in b"
        )
    root_sentence = (
        "both were ready at the same simulated time; whatever decides between them (order of "
        "creation, of subscription, of delivery) is not the same in the two runs"
    )
    if because := case.because():
        root_sentence = f"both were ready at the same simulated time, and {because}"
    return Judgement(Verdict.SCHEDULE, Root.SCHEDULE, sentence, root_sentence, first, second)


def _one_sided(case: Case) -> Judgement:
    one, a = case.one, case.a
    verdict, root = (Verdict.MISSING, Root.MISSING) if a else (Verdict.EXTRA, Root.EXTRA)
    has, has_not = ("a", "b") if a else ("b", "a")
    instead = case.other_b if a else case.other_a
    sentence = f"{phrase(one)} {at_time(one.stamp_ns)} happened only in {has}"
    if case.lost:
        sentence += f": {case.lost}"
    elif case.periods is not None:
        sentence += f": timer period {durations(*case.periods)}"
    elif instead is not None:
        sentence += f"; {has_not} went on with {phrase(instead)} {at_time(instead.stamp_ns)}"
    cause = case.cause_a if a else case.cause_b
    if case.why is not None:
        root_sentence = ""
    elif cause is not None and one.kind is EventKind.RESUME:
        root_sentence = (
            f"it waited for {phrase(cause)} (event {cause.index}) in {has}, and not in {has_not}"
        )
        root_sentence += f"; {case.because() or f'{_itself(one)} is not deterministic'}"
    elif cause is not None:
        root_sentence = (
            f"what it should have received was sent in both runs (event {cause.index}, "
            f"{phrase(cause)}), but {case.lost or f'arrived only in {has}'}"
        )
        because = case.because()
        if because:
            root_sentence += f"; {because}"
        elif case.lost.startswith((GONE, OTHER_QOS)):
            root_sentence += f"; {one.entity.node} is not deterministic"
    elif one.kind is EventKind.BAG:
        root_sentence = case.because() or f"only the bag of {has} has this message"
    elif one.kind is EventKind.OUTSIDE:
        root_sentence = f"whoever drove the simulation did this only in {has}"
    elif one.kind is EventKind.FAULT:
        root_sentence = case.because() or f"the job of {has} has this fault"
    else:
        root_sentence = f"nothing before it differs, and nothing in the trace made it run in {has}"
        if because := case.because():
            root_sentence = f"nothing before it differs, but {because}"
        elif one.entity.kind in _NO_CALLBACKS:
            root_sentence += f": {_itself(one)} is not deterministic"
        elif one.entity.node:
            root_sentence += f": {one.entity.node} is not deterministic"
    return Judgement(verdict, root, sentence, root_sentence, case.a, case.b)


def _exception(case: Case, a: EventView, b: EventView) -> Judgement:
    where, not_where = ("a", "b") if raised(a) else ("b", "a")
    text = next((m.preview for m in case.messages if m.kind is OutputKind.EXCEPTION), "")
    what = f" {text}" if text else " an exception"
    sentence = (
        f"{phrase(a)} {at_time(a.stamp_ns)} raised{what} in {where} and not in {not_where}, "
        "from the same input"
    )
    if any(m.kind is OutputKind.SHUTDOWN and m.presence == f"only {where}" for m in case.messages):
        sentence += ", after it had shut its context down"
    return Judgement(
        Verdict.EXCEPTION,
        Root.EXCEPTION,
        sentence,
        _hidden(case, _itself(a), inside=True),
        a,
        b,
    )


def _timing(case: Case, a: EventView, b: EventView) -> Judgement:
    if a.kind is EventKind.BAG:
        return _bag_timing(case, a, b)
    delta_ns = b.stamp_ns - a.stamp_ns
    if delta_ns:
        late = "later" if delta_ns > 0 else "earlier"
        sentence = (
            f"{phrase(a)} ran {at_time(a.stamp_ns)} in a and {at_time(b.stamp_ns)} in b, "
            f"{format_duration(abs(delta_ns))} {late}"
        )
        if case.periods is not None:
            sentence += f": timer period {durations(*case.periods)}"
        elif case.slept:
            sentence += f": it {case.slept}"
    else:
        sentence = f"{phrase(a)} {at_time(a.stamp_ns)} was due at another time in a than in b"
    return Judgement(
        Verdict.TIMING, Root.TIMING, sentence, _hidden(case, "what sets its time"), a, b
    )


def _bag_timing(case: Case, a: EventView, b: EventView) -> Judgement:
    """A bag decides on the time of its messages, and nothing else does."""
    times = f"{at_time(a.stamp_ns)} in a and {at_time(b.stamp_ns)} in b"
    if case.swapped_with_ns is not None:
        early, late = sorted((a.stamp_ns, b.stamp_ns))
        sentence = (
            f"the bag's messages on {a.entity.name} {at_time(early)} and {at_time(late)} are "
            "swapped"
        )
        why = case.because() or "the bags that were played have these two messages in another order"
    else:
        late_ns = b.stamp_ns - a.stamp_ns
        late_text = "later" if late_ns > 0 else "earlier"
        sentence = f"{phrase(a)} was played {times}, {format_duration(abs(late_ns))} {late_text}"
        why = case.because() or "the bags that were played have this message at another time"
    return Judgement(Verdict.TIMING, Root.EXTERNAL_INPUT, sentence, why, a, b)


def _different_input(case: Case, a: EventView, b: EventView) -> Judgement:
    inputs = [m.topic for m in case.messages if m.position < 0 and m.topic]
    what = f"another {inputs[0]}" if inputs else "another input"
    if a.kind is EventKind.BAG:
        values = next((field_text(m.fields, m.more_fields) for m in case.messages), "")
        told = f" ({values})" if values else ""
        sentence = f"{phrase(a)} {at_time(a.stamp_ns)} is another one{told}"
        root = Root.EXTERNAL_INPUT
        why = case.because() or "the bags that were played differ in this message"
    elif a.kind is EventKind.OUTSIDE:
        sentence = f"{phrase(a)} {at_time(a.stamp_ns)} is another one"
        root, why = Root.EXTERNAL_INPUT, _DRIVEN_DIFFERENTLY
    else:
        sentence = f"{phrase(a)} {at_time(a.stamp_ns)} received {what}"
        root = Root.UNKNOWN
        if case.cause_a is not None and case.cause_b is not None:
            if (a.cause_event, a.cause_output) == (b.cause_event, b.cause_output):
                why = "the same message was sent to it, but something else arrived"
            else:
                why = (
                    f"in a it came from {phrase(case.cause_a)} (event {a.cause_event}), in b from "
                    f"{phrase(case.cause_b)} (event {b.cause_event})"
                )
        else:
            why = "the trace does not say where it came from"
    return Judgement(Verdict.DIFFERENT_INPUT, root, sentence, why, a, b)


def _another_cause(case: Case, a: EventView, b: EventView) -> Judgement:
    if a.cause_event == b.cause_event and a.output_hash != b.output_hash:
        sentence = (
            f"{phrase(a)} {at_time(a.stamp_ns)} did the same in both runs, but in one of them with "
            "delays of 0 ns, which change nothing"
        )
        why = case.because(drawn=True) or "only one of the runs gives what it sent a delay"
        return Judgement(Verdict.DRAW, Root.DRAW, sentence, why, a, b)
    sentence = f"{phrase(a)} {at_time(a.stamp_ns)} received equal inputs, but of other "
    if a.cause_event == b.cause_event:
        sentence += f"outputs of {_event(a.cause_event)}"
    else:
        sentence += f"events: {_event(a.cause_event)} in a, {_event(b.cause_event)} in b"
    why = "two equal messages were delivered in another order"
    return Judgement(Verdict.SCHEDULE, Root.SCHEDULE, sentence, why, a, b)


def _draw(case: Case, a: EventView, b: EventView, draws: Sequence[MessageDifference]) -> Judgement:
    first = draws[0]
    was_a, was_b = (first.fields[0].a, first.fields[0].b) if first.fields else ("?", "?")
    is_clock = first.topic.startswith(CLOCK_OF)
    same = "read a clock" if is_clock else "did the same in both runs"
    because = case.because(drawn=True)
    what = f"{first.topic}: {_drawn(was_a, was_b)} in a, {_drawn(was_b, was_a)} in b"
    if first.topic == drawn_for(a.entity) and not is_clock:
        took = (text.replace("takes ", "").replace(_NO_DRAW, "no time") for text in (was_a, was_b))
        what = "took {} in a and {} in b".format(*took)
    of_delays = any(setting.key.partition(".")[0] in _DRAWN_FROM for setting in case.blamed)
    if _NO_DRAW in (was_a, was_b) and not is_clock and not of_delays:
        has, has_not = ("b", "a") if was_a == _NO_DRAW else ("a", "b")
        what = f"what it sent goes to {first.topic} only in {has}"
        gone = f"in {has_not} nothing is under way to {first.topic}: it is gone, or not connected"
        because = f"{gone}; {because}" if because else gone
    chance = "" if because and "seed" not in because else "chance decided otherwise: "
    sentence = f"{phrase(a)} {at_time(a.stamp_ns)} {same}, but {chance}{what}"
    if len(draws) > 1:
        sentence += f" (and {len(draws) - 1} more)"
    why = because or (
        "job and seed are the same as far as the traces tell, so the stream of this link had been "
        "drawn from a different number of times before"
    )
    return Judgement(Verdict.DRAW, Root.DRAW, sentence, why, a, b)


def _switch(case: Case, a: EventView, b: EventView, met: MessageDifference) -> Judgement:
    """Return the verdict where another thread went on in the middle of a callback."""
    in_a, in_b = (is_switch(number or 0) for number in (met.hash_a, met.hash_b))
    places = met.code or ("a line that is not known",)
    sentence = f"{phrase(a)} {at_time(a.stamp_ns)} "
    if in_a and in_b:
        sentence += f"gave way to another thread before {places[0]} in a, before {places[-1]} in b"
    else:
        one, other = ("a", "b") if in_a else ("b", "a")
        sentence += f"gave way to another thread before {places[0]} in {one}; in {other} it went on"
    why = case.because() or "the policy chose another one of those that could run"
    return Judgement(Verdict.SCHEDULE, Root.SCHEDULE, sentence, why, a, b)


def _drawn(text: str, other: str) -> str:
    return f"no {other.partition(' ')[0]}" if text == _NO_DRAW else text


def _same_input(case: Case, a: EventView, b: EventView) -> Judgement:
    if a.kind is EventKind.OUTSIDE:
        sentence = (
            f"{phrase(a)} {at_time(a.stamp_ns)} is something else{what_differs(case.messages)}"
        )
        root = Root.EXTERNAL_INPUT
        return Judgement(Verdict.DIFFERENT_INPUT, root, sentence, _DRIVEN_DIFFERENTLY, a, b)
    sentence = f"{phrase(a)} {at_time(a.stamp_ns)} "
    if a.input_hash:
        sentence += "got the same input in both runs and "
    if a.output_hash == b.output_hash and a.state_hash != b.state_hash:
        sentence += "sent the same, but left its node in another state"
        sentence += state_text(case.state)
    elif case.slept and all(message.note for message in case.messages):
        sentence = f"{phrase(a)} {at_time(a.stamp_ns)} {case.slept}{what_differs(case.messages)}"
    else:
        sentence += f"did something else{what_differs(case.messages)}"
        sentence += f", and {case.slept}" if case.slept else ""
    return Judgement(
        Verdict.SAME_INPUT_DIFFERENT_OUTPUT,
        Root.CALLBACK,
        sentence,
        _hidden(case, _itself(a), inside=not _suspended(a, b)),
        a,
        b,
    )


# -- words ---------------------------------------------------------------------------------------


def _hidden(case: Case, what: str, *, inside: bool = False) -> str:
    """Say what a root means: nothing that the trace shows differs before it."""
    if case.why == NODE:
        return ""
    if because := case.because(inside=inside):
        return f"nothing before it differs, but {because}"
    text = f"nothing before it differs: {what} is not deterministic"
    if case.one.entity.node and not case.one.state_hash:
        text += (
            f", or the state of {case.one.entity.node} differed before (which "
            "guard: {state: record} in the job tells)"
        )
    if case.relevance.guard_is_off:
        text += "; with guard: false nobody saw what it read from outside"
    return text


def _itself(view: EventView) -> str:
    what = view.entity.kind if view.entity.kind in _NO_CALLBACKS else "callback"
    return f"the {what} itself"


def _suspended(a: EventView, b: EventView) -> bool:
    return EventFlag.SUSPENDED in a.flags | b.flags


def _is_draw(message: MessageDifference) -> bool:
    return message.kind is OutputKind.DRAW


def _event(index: int) -> str:
    return "no event" if index == NO_EVENT else f"event {index}"
