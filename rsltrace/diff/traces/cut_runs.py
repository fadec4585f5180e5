"""Runs that agree until the recording of one of them is cut, or that have nothing to compare."""

from __future__ import annotations

from rsltrace.diff.alignment.entity_matching import match_entities
from rsltrace.diff.causes.job_settings import job_settings
from rsltrace.diff.causes.settings import entity_settings, environment_settings
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result.settings import Setting
from rsltrace.diff.result.traces import Diff
from rsltrace.diff.result.verdicts import Verdict
from rsltrace.diff.traces.sides import interruptions, side
from rsltrace.trace.reader import Trace


def agree_until_cut(a: Trace, b: Trace, options: DiffOptions) -> Diff:
    """Return the diff of two runs that agree as far as both recordings go."""
    events = min(a.event_count, b.event_count)
    cut = [name for name, trace in (("a", a), ("b", b)) if not trace.complete]
    are_cut = "both recordings are cut" if len(cut) == 2 else f"the recording of {cut[0]} is cut"
    if events:
        sentence = f"the two runs agree as far as they go, {events} events: {are_cut}"
    else:
        sentence = f"nothing can be compared: {are_cut}, and has no event"
    return Diff(
        a=side(a),
        b=side(b),
        verdict=Verdict.AS_FAR_AS_THEY_GO,
        sentence=sentence,
        agreeing=events,
        settings=(*job_settings(a, b), *environment_settings(a, b)),
        aligned_to=(events, events),
        bytes_read=a.bytes_read + b.bytes_read,
        notes=tuple(interruptions(a, b)),
        as_far_as_they_go=options.as_far_as_they_go,
    )


def of_different_jobs(a: Trace, b: Trace) -> Diff | None:
    """Return the diff of runs of which one has no event, if their jobs or graphs differ."""
    settings = (*job_settings(a, b), *_different_graphs(a, b))
    if not settings:
        return None
    names = [f'"{trace.job.get("name", "")}"' for trace in (a, b)]
    which = f" ({names[0]}, {names[1]})" if names[0] != names[1] else ""
    empty = " and ".join(name for name, trace in (("a", a), ("b", b)) if not trace.event_count)
    return Diff(
        a=side(a),
        b=side(b),
        verdict=Verdict.DIFFERENT_JOBS,
        sentence=f"these are runs of different jobs{which}, and {empty} "
        f"{'have' if ' ' in empty else 'has'} no event to compare",
        agreeing=0,
        settings=(*settings, *environment_settings(a, b)),
        bytes_read=a.bytes_read + b.bytes_read,
        notes=tuple(interruptions(a, b)),
    )


def _different_graphs(a: Trace, b: Trace) -> tuple[Setting, ...]:
    """Return the entities that only one run has, unless it may be for being cut."""
    ids = a.entities.keys() & b.entities.keys()
    if a.complete and b.complete:
        ids = a.entities.keys() | b.entities.keys()
    if all(a.entities.get(i) == b.entities.get(i) for i in ids):
        return ()
    return entity_settings(match_entities(a, b))
