"""The likely cause of a divergence: different external answers, or the order of a set."""

from __future__ import annotations

import ast
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

from rsltrace.diff.alignment.rows import ComparedTrace
from rsltrace.diff.causes.calls import (
    STARTED_BY,
    subject_of_call,
    unquoted,
    unrecorded_answer,
)
from rsltrace.diff.causes.delivery import entity_changes, topics_of
from rsltrace.diff.causes.event_views import subject_of
from rsltrace.diff.causes.job_entries import module_of
from rsltrace.diff.causes.relevance import Relevance, used_by
from rsltrace.diff.facts.causes import (
    DivergenceKind,
    ErrorInTransition,
    EventInOneRun,
    ExternalAnswers,
    Judgement,
    LikelyCause,
    Root,
    SetOrder,
    UnguardedCall,
    Verdict,
)
from rsltrace.diff.facts.evidence import (
    CallDifference,
    EntityChanges,
    EventSummary,
    MessageDifference,
    OutputOrder,
)
from rsltrace.errors import JobError
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.model.finding import NondeterminismSource, decode_suppressed
from rsltrace.trace.words.code import code_file, code_place

_OF_PROGRAMS = ("os.read()", "os.waitpid()")
"""What ``subprocess`` asks of the system about the program that it has started."""

_HELPERS_MAX = 30
"""Modules that are audited."""

_OPEN_TO_IT = frozenset(
    (Root.CALLBACK, Root.TIMING, Root.MISSING, Root.EXTRA, Root.EXCEPTION, Root.SCHEDULE, Root.JOB)
)
"""Roots that what a node read from outside can be behind."""


_OF_ORDER = (Verdict.SCHEDULE, Verdict.TIMING, Verdict.MISSING, Verdict.EXTRA)
"""Verdicts that QoS and callback groups can be behind."""


def likely_cause(
    judgement: Judgement,
    runs: tuple[ComparedTrace, ComparedTrace],
    calls: Sequence[CallDifference],
    relevance: Relevance,
) -> LikelyCause | None:
    """Return what explains a root: an exception that rclpy suppressed, the first of ``calls`` if
    its answers differ, a set whose order shows, entities with other properties. Else an unrecorded
    answer.
    """
    run_a, run_b = runs
    run = run_b if judgement.a is None else run_a
    view = judgement.one
    if judgement.root not in _OPEN_TO_IT or judgement.why is None or view is None:
        return None
    if (suppressed := suppressed_exception(judgement, runs)) is not None:
        return suppressed
    may_cause = calls
    if judgement.a is None or judgement.b is None:  # what it called itself came after its start
        may_cause = [c for c in calls if view.index not in (c.event_a, c.event_b)]
    if may_cause and may_cause[0].differs:
        changed = judgement.changed
        subject = subject_of(view) if changed is None else changed.node
        telling = telling_calls(may_cause, judgement.messages)
        if all(map(_is_bookkeeping, telling)) and not _answers(telling) & _shown(
            judgement.messages
        ):
            unrecorded = unrecorded_answer(run, view)
            if unrecorded is not None:
                return unrecorded
        return ExternalAnswers(subject, telling)
    if (found := _set_behind(run, view, judgement.messages, calls, relevance)) is not None:
        return found
    if (properties := changed_properties(judgement, runs)) is not None:
        return properties
    if judgement.is_unexplained:
        return _unguarded_call(run, view, relevance.permissions) or unrecorded_answer(run, view)
    return None


def suppressed_exception(
    judgement: Judgement, runs: tuple[ComparedTrace, ComparedTrace]
) -> ErrorInTransition | None:
    """Return the first exception of a lifecycle callback that only one of two events has."""
    in_a, in_b = (
        [one for one in decode_suppressed(run.trace.result) if one.event == event.index]
        if event is not None and run.trace.complete
        else []
        for run, event in zip(runs, (judgement.a, judgement.b), strict=True)
    )
    for a, b in zip_longest(in_a, in_b):
        one = a or b
        error_a, error_b = (None if each is None else each.error for each in (a, b))
        if one is not None and error_a != error_b:
            return ErrorInTransition(one.node, one.callback, one.place, error_a, error_b)
    return None


def changed_properties(
    judgement: Judgement, runs: tuple[ComparedTrace, ComparedTrace]
) -> EntityChanges | None:
    """Return the QoS and callback groups that can be behind another order of events, or time."""
    view = judgement.one
    if view is None or judgement.verdict not in _OF_ORDER or judgement.changed is not None:
        return None
    nodes = frozenset(one.node for one in (judgement.a, judgement.b) if one is not None)
    what = judgement.what  # a history of another depth: other messages are kept for later
    lost = isinstance(what, EventInOneRun) and what.loss is None
    with_depth = lost or what is DivergenceKind.OTHER_SENDER
    run = runs[0] if judgement.a is not None else runs[1]
    topics = topics_of(view, judgement.messages, run)
    return entity_changes(*runs, topics, nodes - {""}, with_depth=with_depth)


def telling_calls(
    calls: Sequence[CallDifference], messages: Sequence[MessageDifference]
) -> tuple[CallDifference, ...]:
    """Return the calls with different answers. Of several those whose answers show in what differs,
    if there are such; else all may be the cause."""
    differing = list({(c.call, c.where): c for c in reversed(calls) if c.differs}.values())[::-1]
    differing = [c for c in differing if not c.only_touched] or differing
    if len(differing) > 1:
        shown = _shown(messages)
        telling = [c for c in differing if _answers((c,)) & shown]
        differing = telling or [c for c in differing if not _is_bookkeeping(c)] or differing
    programs = {c.where: c.call for c in calls if c.call.startswith(STARTED_BY)}
    return tuple(
        replace(c, call=programs[c.where], subject=subject_of_call(c.source, programs[c.where]))
        if c.call in _OF_PROGRAMS and c.where in programs
        else c
        for c in differing
    )


def _is_bookkeeping(call: CallDifference) -> bool:
    """Whether it asks for the process id, which libraries compare with that of before a fork."""
    return call.source == NondeterminismSource.PID.value


def _answers(calls: Sequence[CallDifference]) -> set[str]:
    return {unquoted(value) for call in calls for value in (call.a, call.b) if value}


def _shown(messages: Sequence[MessageDifference]) -> set[str]:
    names = {message.entity.name for message in messages}
    values = (value for m in messages for field in m.fields for value in (field.a, field.b))
    return names | {unquoted(value, '"') for value in values}


# -- the set whose order shows in a message ------------------------------------------------------


def _set_behind(
    run: ComparedTrace,
    view: EventSummary,
    messages: Sequence[MessageDifference],
    calls: Sequence[CallDifference],
    relevance: Relevance,
) -> SetOrder | None:
    """Return the set through which an event goes that sent the same in another order; None if it
    did not, or if its code goes through no set that a run leaves as it is."""
    if not any(map(_is_reordered, messages)):
        return None
    for call in calls:
        if call.source == NondeterminismSource.ORDER.value:
            return SetOrder(call.call, call.where.partition(" in ")[0])
    if relevance.sets_are_in_order:
        return None
    calls_there = _audited_calls(run, view, (NondeterminismSource.ORDER,))
    if calls_there is None:
        return None
    (_, place, what, _), *more = calls_there
    return SetOrder(what, place, len(more))


def _unguarded_call(
    run: ComparedTrace, view: EventSummary, permissions: dict[str, str]
) -> UnguardedCall | None:
    """Return the first call in the code of an event whose answer the jobs permit to be from
    outside; None if there is none, or the code is not here."""
    found = _audited_calls(run, view, permissions) if permissions else None
    if found is None:
        return None
    (file, place, call, source), *more = found
    return UnguardedCall(call, place, file, permissions[source], len(more))


def _is_reordered(message: MessageDifference) -> bool:
    return isinstance(message.fate, OutputOrder) or any(one.is_reordered for one in message.fields)


def _is_as_recorded(run: ComparedTrace, file: Path) -> bool:
    try:
        import hashlib  # OpenSSL takes long to load

        present = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    except OSError:
        return False
    return present in run.trace.metadata(METADATA_SOURCES).values()


def _audited_calls(
    run: ComparedTrace, view: EventSummary, sources: Collection[str]
) -> list[tuple[str, str, str, str]] | None:
    """Return what an audit finds of some sources in the code of an event, else in a module that
    this imports: file, place, call and source; None for nothing, or if the code is not here as it
    was recorded."""
    place = code_place(run.trace, run.trace.event(view.index))
    own = module_of(place)
    helpers = sorted(used_by((run.trace, run.trace), own) - {own})[:_HELPERS_MAX]
    paths = [name.replace(".", "/") for name in helpers]
    for one in (place, *(f"{path}{end}:0" for path in paths for end in (".py", "/__init__.py"))):
        found = code_file(run.trace, one)
        if found is not None and _is_as_recorded(run, found[0]):
            lines = _audited_lines(*found, sources)
            if lines:
                name = one.rpartition(":")[0]
                return [(str(found[0]), f"{name}:{line}", *called) for line, called in lines]
    return None


def _audited_lines(
    file: Path, line: int, sources: Collection[str]
) -> list[tuple[int, tuple[str, str]]]:
    """Return where a file makes nondeterministic calls of some sources: in the function at a line,
    or else anywhere."""
    from rsltrace.guard.audit.audit import audit_path  # most diffs do not need it

    try:
        found = [(o.line, (o.call, o.kind)) for o in audit_path(file).found if o.kind in sources]
        tree = ast.parse(file.read_bytes())
    except (JobError, OSError, SyntaxError, ValueError):
        return []
    ends = (
        node.end_lineno or line
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.lineno == line
    )
    end = next(ends, line)
    return [one for one in found if line <= one[0] <= end] or found
