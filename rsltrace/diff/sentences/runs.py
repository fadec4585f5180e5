"""What is said of two runs, or recordings, as a whole: the answer, and what else to know."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from rsltrace.diff.facts.bags import (
    BagComparison,
    BagVerdict,
    ExtraMessages,
    MessageDivergence,
    NativeComparison,
    TopicDiff,
)
from rsltrace.diff.facts.causes import Judgement
from rsltrace.diff.facts.evidence import Presence
from rsltrace.diff.facts.remarks import (
    DifferentEnd,
    DifferentJobs,
    DifferentStarts,
    DifferentType,
    EndedByException,
    EqualUntilTruncated,
    Identical,
    JobChanged,
    LogTimesIgnored,
    MoreDivergences,
    NativeRuns,
    NoRecordCommand,
    Outcome,
    ReaderNote,
    Remark,
    RenamedProgram,
    RepeatedRun,
    Repeats,
    RunsDiverge,
    SelectionDivergesLater,
    SelectionIsEqual,
    StartIsTolerated,
    TruncatedRecording,
    UndecodedMessages,
    ZeroDelaysBefore,
)
from rsltrace.diff.sentences import SENTENCES, says, sentence
from rsltrace.diff.sentences.values import IN_ONE
from rsltrace.trace.model.texts import format_seconds, printable, shortened
from rsltrace.trace.words.phrases import seconds_text

_OPTIONS_MAX = 3
_TEXT_MAX = 200
ALL_HINT = "--all shows them"


class RunComparison(Protocol):
    @property
    def outcome(self) -> Outcome:
        """The answer itself."""

    @property
    def divergences(self) -> Sequence[Judgement]:
        """Where they diverge."""

    @property
    def effect(self) -> Judgement | None:
        """The first effect of a node that was set up differently."""

    @property
    def native(self) -> NativeComparison | None:
        """What is compared of native runs."""


def answer(of: RunComparison) -> str:
    return sentence(of.outcome, of)


def remark_text(remark: Remark) -> str:
    """Return what else there is to know."""
    return sentence(remark)


# -- the answer ------------------------------------------------------------------------------------


@says(Identical)
def _(outcome: Identical, of: object) -> str:
    but = " except for program names" if outcome.names_differ else ""
    digest = f", digest {outcome.digest}" if outcome.digest else ""
    return f"the two runs are identical{but}: {outcome.events} events{digest}"


@says(EqualUntilTruncated)
def _(outcome: EqualUntilTruncated, of: object) -> str:
    cut = outcome.cut
    are_cut = "both recordings are" if len(cut) == 2 else f"the recording of {cut[0]} is"
    if outcome.events:
        return f"the two runs agree in the first {outcome.events} events; {are_cut} truncated"
    return f"nothing can be compared: {are_cut} truncated and without events"


@says(DifferentJobs)
def _(outcome: DifferentJobs, of: object) -> str:
    names = [f'"{name}"' for name in outcome.jobs]
    which = f" ({names[0]}, {names[1]})" if names[0] != names[1] else ""
    have = "have" if len(outcome.empty) > 1 else "has"
    empty = f"{' and '.join(outcome.empty)} {have} no events to compare"
    return f"these are runs of different jobs{which}, and {empty}"


@says(RunsDiverge)
def _(outcome: RunsDiverge, of: RunComparison) -> str:
    from rsltrace.diff.sentences.divergence import sentence_of
    from rsltrace.diff.sentences.headline import headline

    first = of.divergences[0]
    if outcome.foreign is None:
        return headline(first, of.effect, outcome.searched_to)
    jobs = [f'"{name}"' for name in outcome.foreign]
    which = f" ({jobs[0]}, {jobs[1]})" if len(set(jobs)) == 2 else ""
    unlike = f"these are runs of different jobs{which} without a common node"
    return f"{unlike}: {sentence_of(first)}"


@says(NativeRuns)
def _(outcome: NativeRuns, of: RunComparison) -> str:
    found = of.native
    assert found is not None
    which = "both runs are native" if len(found.native) == 2 else f"{found.native[0]} is native"
    said = sum(topic.agreeing for topic in found.content.topics)
    order = (
        f"{found.moved} of the {found.compared} common callbacks started in a different order"
        if found.moved
        else f"the {found.compared} common callbacks started in the same order"
    )
    if found.differs:
        return f"{which}, and the messages differ{_where(found)}; {order}"
    return (
        f"{which}, and the messages are the same except for times: {said} messages on "
        f"{len(found.content.topics)} topics; {order}"
    )


def _where(found: NativeComparison) -> str:
    first = found.first
    if first is None:
        lone = (*found.content.topics_only_a, *found.content.topics_only_b)
        return f": only one run has messages on {lone[0].topic}"
    shown = first.a or first.b
    text = f", first on {first.topic}"
    if shown is None:
        return text
    text += f": message {shown.index} "
    if first.moved:
        return f"{text}came in a different order, and others are missing or differ"
    if first.presence is not Presence.BOTH:
        return f"{text}is {IN_ONE[first.presence]}"
    return text + (f"has a different {first.fields[0].path}" if first.fields else "differs")


def tail_text(tail: ExtraMessages) -> str:
    """Return ``/odom: 2 more messages at the end of a``."""
    more = f"{tail.more} more message{'' if tail.more == 1 else 's'}"
    return f"{tail.topic}: {more} at the end of {tail.run}"


# -- recordings ------------------------------------------------------------------------------------


def recordings_sentence(of: BagComparison, name: str = "The recordings") -> str:
    """Return the answer for two recordings, or for the messages of two runs."""
    topics, first = of.topics, of.first
    messages = sum(topic.agreeing for topic in topics)
    counted = f"{_number(messages, 'message')} on {_number(len(topics), 'topic')}"
    if of.verdict is BagVerdict.EQUAL:
        return f"{name} are equal: {counted}."
    if of.verdict is not BagVerdict.DIFFERENT:
        return _nearly_equal(of.verdict, topics, counted, name)
    if first is None:
        lone = [f"{topic.topic} is only in a" for topic in of.topics_only_a]
        lone += [f"{topic.topic} is only in b" for topic in of.topics_only_b]
        more = f" and {len(lone) - 3} more" if len(lone) > 3 else ""
        same = f"{counted} agree, but " if messages else ""
        text = f"{same}{', '.join(lone[:3])}{more}."
        return text[0].upper() + text[1:]
    when = f"{format_seconds(first.after_ns)} s after the start"
    return f"{name} first diverge on {first.topic}, {when}: {_first_message(first)}."


def _nearly_equal(verdict: BagVerdict, topics: Sequence[TopicDiff], counted: str, name: str) -> str:
    tolerated = sum(topic.tolerated for topic in topics)
    ignored = sum(topic.ignored for topic in topics)
    if verdict is BagVerdict.AGREE_UNTIL_TRUNCATED:
        how = f"are equal{f' within tolerance ({tolerated} differ)' if tolerated else ''}"
        how += f" except for ignored fields ({ignored} differ there)" if ignored else ""
        return f"{name} agree until one of them is truncated: {counted} {how}."
    if not tolerated:
        ignoring = f"{ignored} of {counted} differ there"
        return f"{name} are equal except for ignored fields, not identical: {ignoring}."
    also = f", {ignored} more only in ignored fields" if ignored else ""
    return (
        f"{name} are equal within tolerance, not identical: {tolerated} of {counted} "
        f"differ within tolerance{also}."
    )


def _first_message(first: MessageDivergence) -> str:
    if first.moved:
        return order_text(first)
    if first.presence is Presence.ONLY_A:
        assert first.a is not None
        return f"message {first.a.index} of a is missing in b"
    if first.presence is Presence.ONLY_B:
        assert first.b is not None
        return f"message {first.b.index} of b is not in a"
    assert first.a is not None
    text = f"message {first.a.index}"
    differing = len(first.fields) + first.more_fields
    if not first.fields:
        return f"{text} differs"
    text = f"{text} has a different {first.fields[0].path}"
    return text if differing == 1 else f"{text} (and {_number(differing - 1, 'other field')})"


def order_text(found: MessageDivergence) -> str:
    """Say where a message is in each recording; "" if it is in the same place of both."""
    if not found.moved or found.a is None or found.b is None:
        return ""
    if found.swapped_at is not None:
        return f"messages {found.swapped_at} and {found.swapped_at + 1} are swapped"
    return f"message {found.a.index} of a is message {found.b.index} of b (different order)"


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


# -- what else to know -----------------------------------------------------------------------------


@says(TruncatedRecording)
def _(remark: TruncatedRecording, of: object) -> str:
    compared = f"{remark.events} events up to {format_seconds(remark.end_ns)} s"
    cut = f"the recording of {remark.run} ({remark.path}) is truncated"
    return f"{cut}: only its {compared} are compared"


@says(DifferentStarts)
def _(remark: DifferentStarts, of: object) -> str:
    a, b = map(seconds_text, (remark.a_ns, remark.b_ns))
    return f"times count from the start of each run: simulated time {a} s in a, {b} s in b"


@says(EndedByException)
def _(remark: EndedByException, of: object) -> str:
    when = f"event {remark.event}, {seconds_text(remark.stamp_ns)} s"
    return f"{remark.run} ended with an exception ({when}): {remark.reason}"


def _globs(globs: Sequence[str]) -> str:
    return printable(", ".join(globs))


@says(SelectionDivergesLater)
def _(remark: SelectionDivergesLater, of: object) -> str:
    shown = f"this report shows where {_globs(remark.asked)} differs"
    return f"the runs diverge at event {remark.start}; {shown}"


@says(StartIsTolerated)
def _(remark: StartIsTolerated, of: object) -> str:
    covered = "but only in ignored fields or within tolerance"
    shown = "this report shows the first other difference"
    return f"the runs diverge at event {remark.start}, {covered}; {shown}"


@says(ZeroDelaysBefore)
def _(remark: ZeroDelaysBefore, of: object) -> str:
    since = f"from event {remark.start} on, one run adds delays of 0 ns, which have no effect"
    return f"{since}; this report shows the first other difference"


@says(MoreDivergences)
def _(remark: MoreDivergences, of: object) -> str:
    hint = "" if remark.all_shown else f"; {ALL_HINT}"
    return f"{remark.count} more independent divergences{hint}"


@says(NoRecordCommand)
def _(remark: NoRecordCommand, of: object) -> str:
    if remark.job:
        job = _shown(remark.job)
        return f"no command to reproduce this: the job {job} of {remark.trace} is not here"
    more = len(remark.options) - _OPTIONS_MAX
    options = ", ".join(map(_shown, remark.options[:_OPTIONS_MAX]))
    options += f" and {more} more" if more > 0 else ""
    return (
        f"no command to reproduce this: {remark.trace} comes from a job that could run code "
        f"({options}); run that only if you trust the source of the trace"
    )


def _shown(text: str) -> str:
    return shortened(printable(text), _TEXT_MAX)


@says(DifferentType)
def _(remark: DifferentType, of: object) -> str:
    a, b = remark.a or "of unknown type", remark.b or "of unknown type"
    return f"{remark.topic} is {a} in a, {b} in b"


def reproduction_text(of: RepeatedRun) -> str:
    """Return which of two runs a third one repeats."""
    if of.place is None:
        too = "is the same too" if of.repeats is Repeats.A else "is different"
        return f"a and b are identical; {of.again} {too}"
    third, where = f"the third run ({of.again})", f"at event {of.place}, where a and b diverge"
    if of.repeats in (Repeats.A, Repeats.B):
        return f"{third} reproduces {of.repeats.value}: it does the same {where}"
    if of.repeats is Repeats.TOO_SHORT:
        return f"{third} ends before event {of.place}, where a and b diverge: record more"
    return (
        f"{third} is a third result: it differs from a at event {of.from_a} and from b at event "
        f"{of.from_b}; a and b diverge at event {of.place}"
    )


SENTENCES.update(
    {
        ReaderNote: lambda fact, of: fact.text,
        DifferentEnd: lambda fact, of: f"{fact.what}: {fact.a} in a, {fact.b} in b",
        RenamedProgram: lambda fact, of: (
            f"{printable(fact.a)} in a is compared with {printable(fact.b)} in b"
        ),
        SelectionIsEqual: lambda fact, of: (
            f"nothing selected ({_globs(fact.asked)}) differs in the aligned events; this report "
            "shows where the runs diverge"
        ),
        JobChanged: lambda fact, of: (
            f"{fact.job} has changed since {fact.trace} was recorded, or the trace is of another "
            "job"
        ),
        LogTimesIgnored: lambda fact, of: (
            "log times are not compared (--by stamp matches messages by them)"
        ),
        UndecodedMessages: lambda fact, of: (
            f"{fact.error}; compared byte by byte, padding included"
        ),
    }
)
