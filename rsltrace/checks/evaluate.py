"""All checks of a job, held against a trace in one pass."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from rsltrace.checks.conditions.condition import ActiveCondition, EventCondition, is_true
from rsltrace.checks.conditions.expressions import Expression, parse_expression
from rsltrace.checks.conditions.names import (
    OF_MESSAGE,
    RunNames,
    names_of,
    topic_of,
    with_topic_prefix,
)
from rsltrace.checks.conditions.occurrences import TopicCondition
from rsltrace.checks.conditions.text import parse_condition
from rsltrace.checks.conditions.trace_events import StartOfTrace, TraceEvent, events_of
from rsltrace.checks.conditions.view import EventView, PausedRun
from rsltrace.checks.latency.instances import quantile
from rsltrace.checks.latency.measure import ChainLatency, Latencies, measuring
from rsltrace.checks.properties import (
    KEPT_MAX,
    EventuallyProperty,
    NeverProperty,
    RateProperty,
    RunProperty,
    Violation,
)
from rsltrace.errors import EXIT_RUN, CheckError, ConditionError, JobError, RsltraceError
from rsltrace.job import Job, job_from_text, locate
from rsltrace.job.parts.check import CheckSpec, LatencySpec
from rsltrace.job.values.checks import Target, target_text
from rsltrace.run.plans.scheduling import load_target
from rsltrace.trace.model.finding import decode_unseen
from rsltrace.trace.model.texts import NS_PER_S, format_duration, format_seconds
from rsltrace.trace.reader import Trace

# Latencies of chains as checks: what takes too long, and where.


_WORDS = {
    "latency": "latency",
    "age": "data age",
    "last_age": "data age at most",
    "reaction": "reaction",
    "worst_reaction": "reaction at worst",
}


@dataclass(frozen=True, slots=True)
class LatencyResult:
    """What takes too long: how often, the first of it, and whether the run ended too early to
    say."""

    count: int = 0
    violations: tuple[Violation, ...] = ()
    undecided: bool = False
    note: str = ""


def latency_title(spec: LatencySpec) -> str:
    """Return what a check says."""
    topics = spec.chain or (spec.start or "", spec.end or "")
    most = f" ({spec.quantile:g} % of them)" if spec.quantile is not None else ""
    named = " → ".join(topics) + (f" via {', '.join(spec.via)}" if spec.via else "")
    return f"{_WORDS[spec.measure]} of {named} below {format_duration(spec.below_ns)}{most}"


MeasuredChains = dict[tuple[object, ...], Latencies]
"""Chains that are measured already, by what was asked for."""


def check_latency(
    trace: Trace, spec: LatencySpec, known: MeasuredChains | None = None
) -> Iterator[LatencyResult | None]:
    """Hold a check against a trace: yield None now and then, and in the end what came of it.

    ``known`` are the chains that checks before were about; these are added.

    :raises TraceError: the trace is damaged.
    """
    known = {} if known is None else known
    asked = tuple(spec.wanted.values())
    found = known.get(asked)
    if found is None:
        for found in measuring(trace, **spec.wanted):
            if found is None:
                yield None
        assert found is not None
        known[asked] = found
    missing = found.missing.replace("--via ", "via: ")
    if missing and not trace.complete:
        yield LatencyResult(undecided=True, note=missing)
    elif missing:
        yield LatencyResult(1, (Violation(None, trace.end_ns, missing),))
    else:
        yield _judged(trace, spec, found)


def _judged(trace: Trace, spec: LatencySpec, found: Latencies) -> LatencyResult:
    late: list[Violation] = []
    count = measured = 0
    for chain in found.chains:
        durations, late_of_chain = _late(trace, spec, chain)
        measured += len(durations)
        if not len(durations):
            continue
        of_all = ""
        if spec.quantile is not None:
            most_ns = quantile(np.sort(durations), spec.quantile)
            if most_ns < spec.below_ns:
                continue
            of_all = f"; p{spec.quantile:g} is {format_duration(most_ns)}"
        count += int((durations >= spec.below_ns).sum())
        late += [Violation(one.event, one.stamp_ns, one.text + of_all) for one in late_of_chain]
    late.sort(key=lambda one: one.event or 0)
    if not measured:
        return LatencyResult(undecided=True, note="there is nothing to measure")
    return LatencyResult(count, tuple(late[:KEPT_MAX]))


def _late(
    trace: Trace, spec: LatencySpec, chain: ChainLatency
) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], list[Violation]]:
    """Return all durations of a chain, with those of inputs that nothing has answered in time, and
    the first that are too long."""
    last = trace.ended_after
    moments = chain.moments(spec.measure)
    durations = moments["duration"]
    if last is not None:  # what nodes do when they are told to end
        moments = moments[moments["output_event"] < last]
        durations = moments["duration"]
    late = [
        Violation(
            int(one["output_event"]),
            int(one["output_ns"]),
            f"{format_duration(int(one['duration']))} since {chain.hops[0].topic} of event "
            f"{int(one['input_event'])} ({format_seconds(trace.stamp(int(one['input_ns'])))} s)",
        )
        for one in moments[durations >= spec.below_ns][:KEPT_MAX]
    ]
    if spec.measure not in ("reaction", "worst_reaction"):
        return durations, late
    waiting = chain.unanswered()
    if last is not None:
        waiting = waiting[waiting["input_event"] < last]
    waited = trace.end_ns - waiting["input_ns"]
    too_long = waiting[waited >= spec.below_ns]
    late += [
        Violation(
            int(one["input_event"]),
            int(one["input_ns"]),
            f"nothing on {chain.hops[-1].topic} came of it, or of a later one, up to the end",
        )
        for one in too_long[:KEPT_MAX]
    ]
    return np.concatenate([durations, waited[waited >= spec.below_ns]]), late


# The texts of checks as conditions: those of the debugger that speak of what others can see.


def condition(text: str, names: RunNames) -> EventCondition:
    """Read what happens.

    :raises ConditionError: it cannot be understood, or no trace says it.
    """
    read = parse_condition(with_topic_prefix(text), names)
    if not read.after or read.reads == {"nodes"}:
        raise ConditionError(
            "a check sees messages, log records, exceptions and findings: say /topic, "
            "/topic: EXPRESSION, log, exception or finding; the rest takes a function",
            text,
        )
    return read


def opposite(text: str, names: RunNames) -> EventCondition:
    """Read what has to be true of all messages, and return the condition that is met by others:
    those of which it is false, or cannot be evaluated.

    :raises ConditionError: as above, or it is not about messages.
    """
    read = condition(text, names)
    if OF_MESSAGE.match(with_topic_prefix(text)) is None:
        raise ConditionError(
            "always is about messages: say /topic: EXPRESSION; for what must not happen, never",
            text,
        )

    def arm(moment: PausedRun) -> ActiveCondition:
        armed = read.arm(moment)
        assert isinstance(armed, TopicCondition)
        return _FalseMessageCondition(armed.text, armed.pattern, armed.expression)

    return replace(read, arm=arm)


@dataclass
class _FalseMessageCondition(TopicCondition):
    """After an event that sends a message of which an expression is not true."""

    def _why(self, what: str, view: EventView, message: object) -> str:
        assert self.expression is not None
        found, note = is_true(self.expression, view, self.text, message)
        self.note = note or self.note
        return "" if found else f"{what}, and not {self.expression.text}"


def compared(text: str) -> Expression | None:
    """Return the left side of the first comparison in a text about messages, to show its value."""
    found = OF_MESSAGE.match(with_topic_prefix(text))
    if found is None:
        return None
    for part in ast.walk(ast.parse(found[2].strip(), mode="eval")):
        if isinstance(part, ast.Compare) and not isinstance(part.left, ast.Constant):
            return parse_expression(ast.unparse(part.left), has_own=True)
    return None


PASSED, VIOLATED, UNDECIDED, SKIPPED = "passed", "violated", "undecided", "skipped"
_NO_NAMES = RunNames()
_SOME_NODE = "nodes=[{node: 'none:None'}]"
"""A job has to have one; it is never made."""

LoadFunction = Callable[[Target], Callable[[Trace], object]]
"""Returns the function that a check names."""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """What came of a check.

    ``verdict``: ``passed``, ``violated``, ``undecided`` (the run ended before it could be said) or
    ``skipped`` (a function, where none are called). ``count`` is the number of violations, of
    which ``violations`` has the first ones, in order. ``note`` says what is odd.
    """

    name: str
    verdict: str
    count: int = 0
    violations: tuple[Violation, ...] = ()
    note: str = ""


def title(spec: CheckSpec) -> str:
    """Return what a check is called: its name, or what it says."""
    if spec.name is not None:
        return spec.name
    if spec.function is not None:
        return f"function {target_text(spec.function)}"
    if spec.latency is not None:
        return latency_title(spec.latency)
    words = f"{spec.kind} {getattr(spec, spec.kind)}"
    for key, bound in (("at least", spec.at_least), ("at most", spec.at_most)):
        words += f" {key} {bound:g} Hz" if bound is not None else ""
    words += f" within {format_duration(spec.within_ns)}" if spec.within_ns is not None else ""
    return words + (f" after {spec.after}" if spec.after is not None else "")


def check_texts(job: Job) -> None:
    """Raise JobError, with its line, at a check that cannot be understood."""
    for index, spec in enumerate(job.checks):
        _conditions(job, index, spec, _NO_NAMES)


def wrong_checks(job: Job, names: RunNames) -> Iterator[str]:
    """Yield, with its line, what is wrong with each check that speaks of what is not there."""
    for index, spec in enumerate(job.checks):
        try:
            _wrong_names(job, index, spec, names)
            _conditions(job, index, spec, names)
        except JobError as error:
            yield str(error).partition("\n")[0]


def job_of_checks(trace: Trace) -> Job:
    """Return the job of a trace, its checks and metrics only: the files of it may be elsewhere.

    :raises JobError: a check cannot be read.
    """
    name = f"the job of {trace.name}"
    text = trace.job_text or "{}"
    only = ("checks", "metrics", "nodes")
    return job_from_text(text, name, ".", overrides=[_SOME_NODE], only=only)


def evaluate_checks(trace: Trace, job: Job, load: LoadFunction | None = None) -> list[CheckResult]:
    """Hold the checks of ``job`` against a trace, in their order; see ``evaluating``."""
    for results in evaluating(trace, job, load):
        if results:
            return results
    return []


def evaluating(
    trace: Trace, job: Job, load: LoadFunction | None = None
) -> Iterator[list[CheckResult]]:
    """Hold the checks of ``job`` against a trace, event by event: yield nothing (an empty list)
    after each, and in the end what came of the checks, in their order.

    ``load`` gives the functions they name; without it, these are skipped.

    :raises JobError: a check names what is not in the run, or cannot be understood.
    :raises CheckError: a check cannot be held against this run.
    :raises TraceError: the trace is damaged, or lacks the messages that a check reads.
    """
    came_to_its_end = trace.complete and trace.result.get("exit_code") != str(EXIT_RUN)
    names = names_of(
        trace.entities.values(),
        are_all=came_to_its_end,
        fields=trace.fields_of,
        unseen=decode_unseen(trace.result),
    )
    held = [property_of(job, index, trace.start_ns, names) for index in range(len(job.checks))]
    properties = [one for one in held if one is not None]
    places = [
        locate(job, ("checks", index, job.checks[index].kind))
        for index, one in enumerate(held)
        if one is not None
    ]
    if properties:
        topics: set[str] | None = set()
        for spec in (one for one in job.checks if one.latency is None):
            topics = _with_topics(topics, spec)
        last = trace.ended_after
        for event in events_of(trace, topics):
            if last is not None and event.index >= last:
                break  # what follows the end
            for one, where in zip(properties, places, strict=True):
                _see(one, event, where)
            yield []
        for one in properties:
            one.end(trace.end_ns, complete=trace.complete)
    results = []
    known: MeasuredChains = {}
    for spec, held_one in zip(job.checks, held, strict=True):
        if held_one is not None:
            results.append(_result(spec, held_one))
        elif spec.latency is None:
            results.append(_of_function(trace, spec, load))
        else:
            for found in check_latency(trace, spec.latency, known):
                if found is None:
                    yield []
                else:
                    results.append(_of_latency(spec, found))
    yield results


def _see(one: RunProperty, event: TraceEvent, where: str) -> None:
    try:
        one.see(event)
    except ConditionError as error:
        message = f"{where}: a check cannot be evaluated: {error.message}\n  {error.text}"
        raise CheckError(message) from None


def _with_topics(topics: set[str] | None, spec: CheckSpec) -> set[str] | None:
    """Add the topics that a check looks at; None: it looks at more."""
    if topics is None or spec.function is not None:
        return topics
    if spec.rate is not None:
        return topics | {spec.rate}
    for text in (spec.always, spec.never, spec.eventually, spec.after):
        if text is not None:
            topic = topic_of(with_topic_prefix(text))
            if topic is None:
                return None
            topics = topics | {topic}
    return topics


def property_of(
    job: Job, index: int, start_ns: int, names: RunNames = _NO_NAMES
) -> RunProperty | None:
    """Return what a check of a job says, ready to be told of events of a run that began at a time;
    None for a function, or a latency.

    :raises JobError: it names what is not in the run, or cannot be understood.
    """
    spec = job.checks[index]
    _wrong_names(job, index, spec, names)
    if spec.function is not None or spec.latency is not None:
        return None
    if spec.rate is not None:
        return RateProperty(
            spec.rate, spec.at_least, spec.at_most, spec.over_ns or NS_PER_S, start_ns
        )
    what, after = _conditions(job, index, spec, names)
    assert what is not None
    start = StartOfTrace(start_ns)
    armed = what.arm(start)
    armed_after: ActiveCondition | None = after.arm(start) if after is not None else None
    if spec.eventually is not None:
        return EventuallyProperty(armed, armed_after, spec.within_ns, start_ns)
    text = spec.always or spec.never or ""
    topic = topic_of(with_topic_prefix(text))
    says = f"not {text}" if spec.always is not None else text if topic is not None else ""
    return NeverProperty(
        armed,
        armed_after,
        spec.within_ns,
        start_ns,
        says=says,
        topic=topic,
        value=compared(text),
    )


def _wrong_names(job: Job, index: int, spec: CheckSpec, names: RunNames) -> None:
    """Raise JobError if a rate, or a latency, is of what is not there."""
    named: list[tuple[tuple[str | int, ...], str]] = []
    if spec.rate is not None:
        named.append((("rate",), spec.rate))
    if (of := spec.latency) is not None:
        both = (("from", of.start), ("to", of.end))
        named += [(("latency", key), topic) for key, topic in both if topic is not None]
        named += [(("latency", "chain", at), topic) for at, topic in enumerate(of.chain)]
        last = named.pop()
        if last[1] not in names.nodes:  # a chain may end in a node
            named.append(last)
        for at, node in enumerate(of.via):
            if wrong := names.unknown(node, names.nodes, "node"):
                raise JobError(wrong, where=locate(job, ("checks", index, "latency", "via", at)))
    for keys, topic in named:
        if wrong := names.unknown(topic, names.topics, "topic"):
            raise JobError(wrong, where=locate(job, ("checks", index, *keys)))


def _conditions(
    job: Job, index: int, spec: CheckSpec, names: RunNames
) -> tuple[EventCondition | None, EventCondition | None]:
    """Return the conditions of a check: what it is about, and after what."""
    what = after = None
    for key in ("always", "never", "eventually"):
        if (text := getattr(spec, key)) is not None:
            with _located(job, index, key):
                what = (opposite if key == "always" else condition)(text, names)
    if spec.after is not None:
        with _located(job, index, "after"):
            after = condition(spec.after, names)
    return what, after


@contextmanager
def _located(job: Job, index: int, key: str) -> Iterator[None]:
    try:
        yield
    except ConditionError as error:
        where = locate(job, ("checks", index, key))
        raise JobError(f"{key}: {error}", where=where) from None


def _result(spec: CheckSpec, one: RunProperty) -> CheckResult:
    verdict = VIOLATED if one.count else UNDECIDED if one.undecided else PASSED
    return CheckResult(title(spec), verdict, one.count, tuple(one.found), one.note)


def _of_latency(spec: CheckSpec, found: LatencyResult) -> CheckResult:
    verdict = VIOLATED if found.count else UNDECIDED if found.undecided else PASSED
    return CheckResult(title(spec), verdict, found.count, found.violations, found.note)


def _of_function(trace: Trace, spec: CheckSpec, load: LoadFunction | None) -> CheckResult:
    assert spec.function is not None
    if load is None:
        return CheckResult(
            title(spec), SKIPPED, note="functions are called for a job's file, not for a trace's"
        )
    found = violations(load(spec.function), target_text(spec.function), trace)
    return CheckResult(title(spec), VIOLATED if found else PASSED, len(found), tuple(found))


# Checks that are functions of the user's: they get the finished trace.


def violations(function: Callable[[Trace], object], name: str, trace: Trace) -> list[Violation]:
    """Call a function and return what it says is wrong.

    :raises CheckError: it raised something else than an AssertionError, or returned
        something that says nothing.
    """
    try:
        said = function(trace)
    except AssertionError as error:
        return [_at_end(trace, str(error) or "it raised AssertionError")]
    except RsltraceError:
        raise
    except Exception as error:
        raise CheckError(f"{name} raised {type(error).__name__}: {error}") from error
    if said is None or said is True:
        return []
    if said is False:
        return [_at_end(trace, "it returned False")]
    if isinstance(said, str):
        return [_at_end(trace, said)]
    if isinstance(said, Iterable):
        return [_violation(trace, name, one) for one in said]
    raise CheckError(
        f"{name} returned {said!r}: nothing or True (all is well), False, a text, or a list of "
        "(event, text)"
    )


def load_function(target: Target) -> Callable[[Trace], object]:
    """Return the function that a check names, imported from the job's search path.

    :raises JobError: there is none.
    """
    if not isinstance(target, str):
        return target
    loaded: Callable[[Trace], object] = load_target(target, where=f"checks: function {target}")
    return loaded


def _at_end(trace: Trace, text: str) -> Violation:
    return Violation(None, trace.end_ns, text)


def _violation(trace: Trace, name: str, said: object) -> Violation:
    if isinstance(said, str):
        return _at_end(trace, said)
    if isinstance(said, tuple) and len(said) == 2 and isinstance(said[1], str):
        index, text = said
        if isinstance(index, int) and 0 <= index < trace.event_count:
            return Violation(int(index), trace.event(int(index)).stamp_ns, text)
    raise CheckError(
        f"{name} returned a list with {said!r}: expected (event, text), with an event of the trace"
    )
