"""Two runs that are not the same, from the event on where they diverge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cached_property

from rsltrace.diff.alignment.blocks import (
    AlignedBlock,
    AlignedBlocks,
    EqualBlock,
    EventPair,
)
from rsltrace.diff.alignment.entity_matching import EntityMatching, match_entities
from rsltrace.diff.alignment.outputs import different_outputs
from rsltrace.diff.alignment.rows import Run
from rsltrace.diff.causes.effects import EffectSearch
from rsltrace.diff.causes.explain import Explainer
from rsltrace.diff.causes.headline import headline
from rsltrace.diff.causes.job_settings import job_settings
from rsltrace.diff.causes.propagation import (
    FoundDivergence,
    Propagation,
)
from rsltrace.diff.causes.settings import entity_settings, environment_settings
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result.divergence import Divergence
from rsltrace.diff.result.settings import Setting
from rsltrace.diff.result.traces import Diff
from rsltrace.diff.result.verdicts import Verdict
from rsltrace.diff.traces.counts import EventCounts
from rsltrace.diff.traces.ended_runs import (
    failure_text,
    failures,
    had_nothing_left,
    judge_end,
    who_ended,
)
from rsltrace.diff.traces.renamed import first_real_difference
from rsltrace.diff.traces.sides import interruptions, side
from rsltrace.diff.traces.tolerance import messages_within
from rsltrace.errors import TraceError, did_you_mean
from rsltrace.model.entity import EntityKind
from rsltrace.model.printable import printable
from rsltrace.trace.reader import Trace

DIVERGENCES_MAX = 10
"""Independent divergences told unless everything is asked for."""

EVERY_DIVERGENCE_MAX = 1000
"""Told even then; each takes some milliseconds and some lines."""

EFFECT_WITHIN = 100_000
"""Events after the first divergence among which its first effect is looked for."""

_EVENTS_PER_BLOCK = 4096
_TELL_THE_END = (Verdict.EXCEPTION, Verdict.ENDED_EARLY, Verdict.RAN_LONGER)


def compare(a: Trace, b: Trace, start: int, options: DiffOptions) -> Diff:
    """Return the diff of two runs that differ from event ``start`` on.

    Raises TraceError if neither run has a node or topic that is asked for.
    """
    _check_names(a, b, options)
    return _Comparison(a, b, start, options).run()


def _check_names(a: Trace, b: Trace, options: DiffOptions) -> None:
    entities = [entity for trace in (a, b) for entity in trace.entities.values()]
    nodes = {entity.name for entity in entities if entity.kind is EntityKind.NODE}
    names = {entity.name for entity in entities}
    for what, globs, known in (
        ("node", options.nodes, nodes),
        ("topic or service", options.topics, names),
    ):
        for glob in globs:
            if not any(fnmatchcase(name, glob) for name in known):
                raise TraceError(
                    f"neither run has a {what} {printable(glob)}{did_you_mean(glob, known)}"
                )


class _Comparison:
    """Of two runs that differ from event ``start`` on."""

    def __init__(self, a: Trace, b: Trace, start: int, options: DiffOptions) -> None:
        self._a = a
        self._b = b
        self._start = start
        self._options = options
        self._matching: EntityMatching = match_entities(a, b)
        self._job = job_settings(a, b)
        delays = any(setting.key.partition(".")[0] == "delay" for setting in self._job)
        self._run_a = Run(a, self._matching, of_b=False, without_zero_delays=delays)
        self._run_b = Run(b, self._matching, of_b=True, without_zero_delays=delays)
        self._environment = environment_settings(a, b)
        self._notes = list(interruptions(a, b))
        self._only_names = False
        """Whether the runs are the same but for names of programs."""
        if self._matching.renamed:
            real = first_real_difference(self._run_a, self._run_b, start)
            self._only_names = real is None
            self._start = start if real is None else real
            self._notes += [
                f"{printable(name_a)} in a is compared with {printable(name_b)} in b"
                for name_a, name_b in self._matching.renamed
            ]
        self._counts = EventCounts()
        self._aligned_to = (start, start)
        self._effect: Divergence | None = None
        self._in_vain: str | None = None
        """Up to where no effect was found, if there was one to look for."""

    def run(self) -> Diff:
        """Return the answer."""
        if self._only_names and self._a.complete and self._b.complete:
            return self._same_but_for_names()
        over = who_ended(self._a, self._b, self._start)
        divergences = [self._ended(over)] if over is not None else self._aligned()
        divergences[0] = first = self._with_failure(divergences[0])
        if first.verdict not in _TELL_THE_END:
            self._notes += failures(self._a, self._b)
        return Diff(
            a=side(self._a),
            b=side(self._b),
            verdict=first.verdict,
            sentence=self._sentence(first),
            effect=self._effect,
            agreeing=self._start,
            divergences=tuple(divergences),
            settings=(*self._job, *self._environment, *entity_settings(self._matching)),
            counts=self._counts.counts(self._matching),
            resync_index=self._counts.resync,
            aligned_to=self._aligned_to,
            bytes_read=self._a.bytes_read + self._b.bytes_read,
            notes=tuple(self._notes),
            tolerance=messages_within(self._a, self._b, self._start, self._options),
        )

    def _same_but_for_names(self) -> Diff:
        events = self._a.event_count
        return Diff(
            a=side(self._a),
            b=side(self._b),
            verdict=Verdict.IDENTICAL,
            sentence=f"the two runs are identical but for names of programs: {events} events",
            agreeing=events,
            settings=(*self._job, *self._environment),
            aligned_to=(events, events),
            bytes_read=self._a.bytes_read + self._b.bytes_read,
            notes=tuple(self._notes),
        )

    def _with_failure(self, first: Divergence) -> Divergence:
        """Add to the cause how one of the runs failed, where that is not said already."""
        text = failure_text(self._a, self._b)
        if not text or first.verdict in _TELL_THE_END or not first.root_sentence:
            return first
        return replace(first, root_sentence=f"{first.root_sentence}; {text}")

    def _sentence(self, first: Divergence) -> str:
        if not self._matching.different_jobs:
            return headline(first, self._effect, in_vain=self._in_vain)
        jobs = [f'"{trace.job["name"]}"' for trace in (self._a, self._b) if trace.job.get("name")]
        which = f" ({jobs[0]}, {jobs[1]})" if len(set(jobs)) == 2 else ""
        return f"these are runs of different jobs{which} without a common node: {first.sentence}"

    def _explainer(self, found: list[FoundDivergence]) -> Explainer:
        settings: tuple[Setting, ...] = (*self._job, *self._environment)
        return Explainer(self._run_a, self._run_b, self._options, settings, found)

    def _ended(self, over: Trace) -> Divergence:
        explainer = self._explainer([])
        of_b = over is self._a
        view = explainer.view(self._start, of_b=of_b)
        alone = explainer.alone(self._start, of_b=of_b) if had_nothing_left(over) else None
        judgement = judge_end(self._a, self._b, over, view, self._job, alone)
        return explainer.ended(self._start, judgement)

    def _aligned(self) -> list[Divergence]:
        options = self._options
        watch = self._wanted if options.nodes or options.topics else None
        propagation = Propagation(watch)
        per_block = options.window
        if options.everything:
            per_block = max(options.window, _EVENTS_PER_BLOCK)
        blocks = AlignedBlocks(
            self._run_a, self._run_b, self._start, per_block, skip_equal=options.everything
        )
        wanted: list[FoundDivergence] = []
        search = None if watch is not None else EffectSearch(self._covered)
        for block in blocks:
            self._aligned_to = (block.end_a, block.end_b)
            if isinstance(block, EqualBlock):
                self._counts.take_equal(block)
                continue
            known = len(propagation.found)
            first = self._first(block) if not known else None
            propagation.take(block, first)
            self._counts.take(block)
            new = propagation.found[known:]
            wanted += [f for f in new if watch is None or watch(f.origin.item, block)]
            if search is not None:
                search.take(block, propagation)
            far = block.end_a - self._start >= EFFECT_WITHIN
            if not options.everything and (search is None or not search.going_on or far):
                break
            blocks.skip_equal = True
        return self._divergences(propagation, wanted, search)

    @cached_property
    def _covered(self) -> Callable[[EventPair], bool] | None:
        """Say of a pair whether all that differs in it is ignored or within tolerance."""
        if not self._options.tolerant and not self._options.ignore:
            return None
        explainer = self._explainer([])
        return explainer.is_covered

    def _first(self, block: AlignedBlock) -> EventPair:
        """Return the pair at which the runs diverge; a delay of 0 ns alone is no divergence."""
        first = first_item(block, self._start)
        if first.plain and self._run_a.without_zero_delays:
            return next((item for item in block.items if not item.plain), first)
        return first

    def _divergences(
        self,
        propagation: Propagation,
        wanted: list[FoundDivergence],
        search: EffectSearch | None,
    ) -> list[Divergence]:
        chosen = list(wanted)
        if search is not None and search.past_covered:
            chosen = self._past_covered(chosen, search)
        if propagation.watched is not None:
            chosen.append(propagation.watched)
            chosen.sort(key=lambda found: (found.place_a, found.place_b))
        if not chosen:
            chosen = propagation.found[:1]
            self._notes.append(
                f"nothing that was asked for ({self._asked()}) differs among the events that were "
                "aligned; shown is where the runs diverge"
            )
        elif propagation.found[0] is not chosen[0]:
            self._notes.append(
                f"the runs diverge at event {self._start}; shown is where {self._asked()} differs"
            )
        most = EVERY_DIVERGENCE_MAX if self._options.everything else DIVERGENCES_MAX
        if len(chosen) > most:
            hint = "" if self._options.everything else "; --all shows them"
            self._notes.append(f"{len(chosen) - most} more independent divergences{hint}")
        explainer = self._explainer(propagation.found)
        divergences = [explainer.explain(found) for found in chosen[:most]]
        if search is not None and not search.past_covered and search.found is not None:
            self._effect = explainer.explain_effect(search.found, divergences[0])
        if search is not None and search.in_vain:
            ends = (self._a.event_count, self._b.event_count)
            whole = self._aligned_to == ends
            self._in_vain = "" if whole else f" up to event {self._aligned_to[0]}"
        self._notes += explainer.warnings
        return divergences

    def _past_covered(
        self, chosen: list[FoundDivergence], search: EffectSearch
    ) -> list[FoundDivergence]:
        """Return what to show if the first divergence is ignored or within tolerance."""
        covered = "only in what is ignored or within tolerance"
        if search.found is None:
            return chosen  # what all messages say of that is told beside it
        self._notes.append(
            f"the runs diverge at event {self._start}, but there {covered}; shown is the first "
            "difference that is not"
        )
        place = search.found.place_a
        return [search.found, *(found for found in chosen if found.place_a > place)]

    def _asked(self) -> str:
        return ", ".join((*self._options.nodes, *self._options.topics))

    def _wanted(self, item: EventPair, block: AlignedBlock) -> bool:
        """Whether an item is of a node and touches a topic that was asked for."""
        options, keys = self._options, self._matching.keys
        a, b = block.rows_a, block.rows_b
        rows, index = (a, item.a) if item.a >= 0 else (b, item.b)
        number = rows.number[index - rows.first]
        if not options.wants_node(keys[number].node):
            return False
        if not options.topics:
            return True
        outputs_a = a.outputs(item.a) if item.a >= 0 else []
        outputs_b = b.outputs(item.b) if item.b >= 0 else []
        touched = {number, *(n for _, n, _, _ in different_outputs(outputs_a, outputs_b))}
        return any(options.wants_topic(keys[n].name) for n in touched)


def first_item(block: AlignedBlock, start: int) -> EventPair:
    """Return the pair at which the runs diverge: of event ``start`` of a, or of b.

    What came first in time leads, since the other run's event may be a consequence that only moved.
    Of two at one time it is what only one run has, then what moved to another time, then what did
    the same, then the one whose name comes first: the same whichever run is a.
    """
    found = {}
    for rows, of_b in ((block.rows_a, False), (block.rows_b, True)):
        for item in block.items:
            if (item.b if of_b else item.a) == start:
                place = start - rows.first
                paired = item.a >= 0 and item.b >= 0
                still = paired and not _moved(block, item)
                name = str(rows.run.matching.keys[rows.number[place]])
                found[rows.stamp[place], paired, still, not item.same, name] = item
    assert found, "a block holds the event it starts with"
    return found[min(found)]


def _moved(block: AlignedBlock, item: EventPair) -> bool:
    a, b = block.rows_a, block.rows_b
    return a.stamp[item.a - a.first] != b.stamp[item.b - b.first]
