"""Runs that agree until the recording of one of them is cut, or that have nothing to compare."""

from __future__ import annotations

from rsltrace.diff.alignment.entity_matching import match_entities
from rsltrace.diff.causes.environment import entity_settings, environment_settings
from rsltrace.diff.causes.job_settings import job_settings
from rsltrace.diff.facts.causes import Verdict
from rsltrace.diff.facts.evidence import Setting
from rsltrace.diff.facts.remarks import AgreeUntilCut, DifferentJobs
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import Diff
from rsltrace.diff.traces.sides import interruptions, side
from rsltrace.trace.reader import Trace


def agree_until_cut(a: Trace, b: Trace, options: DiffOptions) -> Diff:
    """Return the diff of two runs that agree as far as both recordings go."""
    events = min(a.event_count, b.event_count)
    cut = tuple(name for name, trace in (("a", a), ("b", b)) if not trace.complete)
    return Diff(
        a=side(a),
        b=side(b),
        verdict=Verdict.AS_FAR_AS_THEY_GO,
        outcome=AgreeUntilCut(events, cut),
        agreeing=events,
        settings=(*job_settings(a, b), *environment_settings(a, b)),
        aligned_to=(events, events),
        bytes_read=a.bytes_read + b.bytes_read,
        remarks=tuple(interruptions(a, b)),
        as_far_as_they_go=options.as_far_as_they_go,
    )


def of_different_jobs(a: Trace, b: Trace) -> Diff | None:
    """Return the diff of runs of which one has no event, if their jobs or graphs differ."""
    settings = (*job_settings(a, b), *_different_graphs(a, b))
    if not settings:
        return None
    empty = tuple(name for name, trace in (("a", a), ("b", b)) if not trace.event_count)
    return Diff(
        a=side(a),
        b=side(b),
        verdict=Verdict.DIFFERENT_JOBS,
        outcome=DifferentJobs((a.job.get("name", ""), b.job.get("name", "")), empty),
        agreeing=0,
        settings=(*settings, *environment_settings(a, b)),
        bytes_read=a.bytes_read + b.bytes_read,
        remarks=tuple(interruptions(a, b)),
    )


def _different_graphs(a: Trace, b: Trace) -> tuple[Setting, ...]:
    """Return the entities that only one run has, unless it may be for being cut."""
    ids = a.entities.keys() & b.entities.keys()
    if a.complete and b.complete:
        ids = a.entities.keys() | b.entities.keys()
    if all(a.entities.get(i) == b.entities.get(i) for i in ids):
        return ()
    return entity_settings(match_entities(a, b))
