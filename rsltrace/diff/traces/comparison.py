"""Two runs that are not the same, from the event on where they diverge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rsltrace.diff.alignment.aligned_rows import ALIGNED_MAX, AlignedRows
from rsltrace.diff.alignment.blocks import (
    AlignedBlock,
    AlignedBlocks,
    EqualBlock,
    EventPair,
    equal_block,
)
from rsltrace.diff.alignment.entity_matching import EntityMatching, match_entities
from rsltrace.diff.alignment.outputs import different_outputs
from rsltrace.diff.alignment.rows import SHUTDOWN, ComparedTrace, load_rows
from rsltrace.diff.causes.effects import EffectSearch
from rsltrace.diff.causes.explain import Explainer
from rsltrace.diff.causes.job_settings import job_settings
from rsltrace.diff.causes.propagation import FoundDivergence, Propagation
from rsltrace.diff.causes.relevance import entity_settings, environment_settings
from rsltrace.diff.facts.causes import Verdict
from rsltrace.diff.facts.evidence import Setting
from rsltrace.diff.facts.remarks import (
    DifferentStarts,
    Identical,
    MoreDivergences,
    RenamedProgram,
    RunsDiverge,
    SelectionDivergesLater,
    SelectionIsEqual,
    StartIsTolerated,
    ZeroDelaysBefore,
)
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import BagDiff, Diff, Divergence, EntityCount, interruptions, side
from rsltrace.diff.traces.ended_runs import (
    failure,
    failures,
    had_nothing_left,
    judge_end,
    who_ended,
)
from rsltrace.errors import TraceError, near_or_all
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_SEQUENCE, OutputKind
from rsltrace.trace.model.texts import printable
from rsltrace.trace.reader import Trace

# Whether two runs that diverge are equal within tolerance after all.
#
# A tolerance at the first divergence says little: what follows from it may grow. So all messages of
# both runs are compared, which takes reading all of both; that is done only if tolerances are given
# and the runs otherwise did the same things at the same times.

_SAME_EVENTS = "stamp entity kind flags outputs cause_event cause_output".split()
_SAME_OUTPUTS = "event entity kind".split()
_WITH_MESSAGE = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE, OutputKind.LOG)
_ENDED_ALIKE = ("stop_reason", "exit_code", "end_time")
_AT_ONCE = 4096


def messages_within(a: Trace, b: Trace, start: int, options: DiffOptions) -> BagDiff | None:
    """Compare all messages of two runs that diverge at event ``start``.

    Return None if no tolerance is given, or if more than the contents of messages differs:
    events, their order and times, outputs that are no messages or were not recorded.
    """
    if not (options.tolerant or options.ignore) or not _alike_but_for_messages(a, b, start):
        return None
    from rsltrace.diff.bags.comparison import (
        compare_messages,  # what recordings need, and most diffs do not
    )

    return compare_messages(a, b, options)


def _alike_but_for_messages(a: Trace, b: Trace, start: int) -> bool:
    if a.event_count != b.event_count or a.output_count != b.output_count:
        return False
    if any(a.result.get(key) != b.result.get(key) for key in _ENDED_ALIKE):
        return False
    if not (a.complete and b.complete) or a.entities != b.entities:
        return False
    for first in range(start, a.event_count, _AT_ONCE):
        last = first + _AT_ONCE
        events_a, events_b = (_joined(list(trace.events(first, last))) for trace in (a, b))
        if not all(np.array_equal(events_a[name], events_b[name]) for name in _SAME_EVENTS):
            return False
        outputs_a, outputs_b = (_joined(list(trace.outputs(first, last))) for trace in (a, b))
        if not all(np.array_equal(outputs_a[name], outputs_b[name]) for name in _SAME_OUTPUTS):
            return False
        other = outputs_a["hash"] != outputs_b["hash"]
        kept = np.isin(outputs_a["kind"], [int(kind) for kind in _WITH_MESSAGE])
        kept &= (outputs_a["sequence"] != NO_SEQUENCE) & (outputs_b["sequence"] != NO_SEQUENCE)
        if (other & ~kept).any():
            return False
    return True


def _joined(parts: list[npt.NDArray[np.void]]) -> npt.NDArray[np.void]:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


DIVERGENCES_MAX = 10
"""Independent divergences shown unless ``everything`` is set."""

EVERY_DIVERGENCE_MAX = 1000
"""The limit even then; each takes some milliseconds and some lines."""

EFFECT_WITHIN = 100_000
"""Events after the first divergence among which its first effect is looked for."""

_EVENTS_PER_BLOCK = 4096
AGREEING_MIN = 32
"""So many events in a row have to agree before it is called agreement …"""

AGREEING_AT_END_MIN = 8
"""… or so many if they are the last ones of both runs. Shutting down is no agreement."""

_ROWS_AT_ONCE = 256
_TELL_THE_END = (Verdict.EXCEPTION, Verdict.ENDED_EARLY, Verdict.RAN_LONGER)


def compare(a: Trace, b: Trace, start: int, options: DiffOptions) -> Diff:
    """Return the diff of two runs that differ from event ``start`` on.

    Raises TraceError if neither run has a selected node or topic.
    """
    _check_names(a, b, options)
    return _TraceComparison(a, b, start, options).run()


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
                    f"neither run has a {what} {printable(glob)}{near_or_all(glob, sorted(known))}"
                )


class _TraceComparison:
    """Of two runs that differ from event ``start`` on."""

    def __init__(self, a: Trace, b: Trace, start: int, options: DiffOptions) -> None:
        self._a = a
        self._b = b
        self._start = start
        self._options = options
        self._matching: EntityMatching = match_entities(a, b)
        self._job = job_settings(a, b)
        delays = any(setting.part == "delay" for setting in self._job)
        self._run_a = ComparedTrace(a, self._matching, of_b=False, without_zero_delays=delays)
        self._run_b = ComparedTrace(b, self._matching, of_b=True, without_zero_delays=delays)
        self._environment = environment_settings(a, b)
        self._remarks = list(interruptions(a, b))
        if a.start_ns != b.start_ns:
            self._remarks.append(DifferentStarts(a.start_ns, b.start_ns))
        self._only_names = False
        """Whether the runs are the same except for program names."""
        if self._matching.renamed:
            real = first_real_difference(self._run_a, self._run_b, start)
            self._only_names = real is None
            self._start = start if real is None else real
            self._remarks += [RenamedProgram(*names) for names in self._matching.renamed]
        self._rows = AlignedRows(a.event_count, b.event_count, self._start)
        self._counts = _EventCounts()
        self._aligned_to = (start, start)
        self._effect: Divergence | None = None
        self._searched_to: int | None = None
        """See ``RunsDiverge``."""

    def run(self) -> Diff:
        if self._only_names and self._a.complete and self._b.complete:
            return self._same_but_for_names()
        over = who_ended(self._a, self._b, self._start)
        divergences = [self._ended(over)] if over is not None else self._aligned()
        divergences[0] = first = self._with_failure(divergences[0])
        if first.verdict not in _TELL_THE_END:
            self._remarks += failures(self._a, self._b)
        return Diff(
            a=side(self._a),
            b=side(self._b),
            verdict=first.verdict,
            outcome=self._outcome(),
            effect=self._effect,
            agreeing=self._start,
            divergences=tuple(divergences),
            settings=(*self._job, *self._environment, *entity_settings(self._matching)),
            counts=self._counts.counts(self._matching),
            resync_index=self._counts.resync,
            aligned_to=self._aligned_to,
            bytes_read=self._a.bytes_read + self._b.bytes_read,
            remarks=tuple(self._remarks),
            tolerance=messages_within(self._a, self._b, self._start, self._options),
        )

    def _same_but_for_names(self) -> Diff:
        events = self._a.event_count
        return Diff(
            a=side(self._a),
            b=side(self._b),
            verdict=Verdict.IDENTICAL,
            outcome=Identical(events, names_differ=True),
            agreeing=events,
            settings=(*self._job, *self._environment),
            aligned_to=(events, events),
            bytes_read=self._a.bytes_read + self._b.bytes_read,
            remarks=tuple(self._remarks),
        )

    def _with_failure(self, first: Divergence) -> Divergence:
        """Add how one of the runs failed, where that is not known already."""
        failed = failure(self._a, self._b)
        if failed is None or first.verdict in _TELL_THE_END or first.why is None:
            return first
        return replace(first, failed=failed)

    def _outcome(self) -> RunsDiverge:
        foreign = None
        if self._matching.different_jobs:
            jobs = (trace.job.get("name") for trace in (self._a, self._b))
            foreign = tuple(name for name in jobs if name)
        return RunsDiverge(self._searched_to, foreign)

    def _explainer(self, found: list[FoundDivergence]) -> Explainer:
        settings: tuple[Setting, ...] = (*self._job, *self._environment)
        return Explainer(self._run_a, self._run_b, self._options, settings, found, self._rows)

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
        start: AlignedBlock | None = None
        for block in blocks:
            self._aligned_to = (block.end_a, block.end_b)
            if self._rows.matched < ALIGNED_MAX:
                self._rows.take(block)
            if isinstance(block, EqualBlock):
                self._counts.take_equal(block)
                continue
            self._counts.take(block)
            start = start or block
            far = block.end_a - self._start >= EFFECT_WITHIN
            known = len(propagation.found)
            first = self._first(block) if not known else None
            if first is None and not known:  # nothing but delays of 0 ns differs so far
                blocks.skip_equal = True
                if not block.at_end and not (far and not options.everything):
                    continue
                block, first = start, first_item(start, self._start)
                self._searched_to = self._to_end
            propagation.take(block, first)
            new = propagation.found[known:]
            wanted += [f for f in new if watch is None or watch(f.origin.item, block)]
            if search is not None:
                search.take(block, propagation)
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

    def _first(self, block: AlignedBlock) -> EventPair | None:
        """Return the pair at which the runs diverge; None where only delays of 0 ns differ, which
        is no divergence."""
        if block.rows_a.first <= self._start:
            first = first_item(block, self._start)
            if not first.plain or not self._run_a.without_zero_delays:
                return first
        found = next((item for item in block.items if not item.plain), None)
        if found is not None:
            self._remarks.append(ZeroDelaysBefore(self._start))
        return found

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
            self._remarks.append(SelectionIsEqual(self._asked))
        elif self._asked and propagation.found[0] is not chosen[0]:
            self._remarks.append(SelectionDivergesLater(self._start, self._asked))
        most = EVERY_DIVERGENCE_MAX if self._options.everything else DIVERGENCES_MAX
        if len(chosen) > most:
            more = MoreDivergences(len(chosen) - most, all_shown=self._options.everything)
            self._remarks.append(more)
        explainer = self._explainer(propagation.found)
        divergences = [explainer.explain(found) for found in chosen[:most]]
        if search is not None and not search.past_covered and search.found is not None:
            self._effect = explainer.explain_effect(search.found, divergences[0])
        if search is not None and search.in_vain:
            self._searched_to = self._to_end
        self._remarks += explainer.warnings
        return divergences

    @property
    def _to_end(self) -> int:
        """See ``RunsDiverge.searched_to``."""
        whole = self._aligned_to == (self._a.event_count, self._b.event_count)
        return -1 if whole else self._aligned_to[0]

    def _past_covered(
        self, chosen: list[FoundDivergence], search: EffectSearch
    ) -> list[FoundDivergence]:
        """Return what to show if the first divergence is ignored or within tolerance."""
        if search.found is None:
            return chosen  # ``tolerance`` of the diff covers it
        self._remarks.append(StartIsTolerated(self._start))
        place = search.found.place_a
        return [search.found, *(found for found in chosen if found.place_a > place)]

    @property
    def _asked(self) -> tuple[str, ...]:
        return (*self._options.nodes, *self._options.topics)

    def _wanted(self, item: EventPair, block: AlignedBlock) -> bool:
        """Whether an item is of a node and touches a topic that is selected."""
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


# -- what is counted -----------------------------------------------------------------------------


class _EventCounts:
    """Takes blocks in order."""

    def __init__(self) -> None:
        self._counts: dict[int, list[int]] = {}
        self._resync: tuple[int, int] | None = None
        self._agreeing = 0
        self._ended = False

    def take(self, block: AlignedBlock) -> None:
        for item in block.items:
            rows, index = (block.rows_a, item.a) if item.a >= 0 else (block.rows_b, item.b)
            counts = self._counts.setdefault(rows.number[index - rows.first], [0, 0, 0, 0])
            counts[_column(item)] += 1
            if not item.plain:
                self._agreeing, self._resync = 0, None
            elif rows.kind[index - rows.first] != SHUTDOWN:
                self._agreeing += 1
                self._resync = self._resync or (item.a, item.b)
        self._ended = block.at_end

    def take_equal(self, run: EqualBlock) -> None:
        """Count a run of equal events."""
        for number in run.counts.nonzero()[0].tolist():
            self._counts.setdefault(number, [0, 0, 0, 0])[0] += int(run.counts[number])
        self._agreeing += int(run.counts.sum())
        self._resync = self._resync or (run.first_a, run.first_b)

    def counts(self, matching: EntityMatching) -> tuple[EntityCount, ...]:
        """Return the counts of each entity that had events, those that differ most first."""
        counts = [EntityCount(matching.keys[n], *row) for n, row in self._counts.items()]
        return tuple(
            sorted(counts, key=lambda c: (-(c.differing + c.only_a + c.only_b), str(c.entity)))
        )

    @property
    def resync(self) -> tuple[int, int] | None:
        """The indexes from which on the runs agree to the end of what was aligned, if they do."""
        enough = AGREEING_AT_END_MIN if self._ended else AGREEING_MIN
        return self._resync if self._agreeing >= enough else None


def _column(item: EventPair) -> int:
    if item.b < 0:
        return 2
    if item.a < 0:
        return 3
    return 0 if item.same else 1


# -- runs whose programs have other names, two builds of one ---------------------------------------


def first_real_difference(run_a: ComparedTrace, run_b: ComparedTrace, start: int) -> int | None:
    """Return the index of the first event from ``start`` on that differs in more than names: they
    are in the trace's own hashes of what a main's construction has made, and so in all chain hashes
    after it.

    Where one run is the beginning of the other it is the number of events of the shorter one;
    None if they do the same.
    """
    counts = run_a.trace.event_count, run_b.trace.event_count
    index, end = start, min(counts)
    while index < end:
        equal = equal_block(run_a, run_b, index, index)
        if equal is not None:
            index = equal.end_a
            continue
        last = min(index + _ROWS_AT_ONCE, end)
        a, b = (load_rows(run, index, last) for run in (run_a, run_b))
        columns = ("number", "kind", "stamp", "input", "content", "flags", "state", "cause")
        for place in range(last - index):
            if any(getattr(a, name)[place] != getattr(b, name)[place] for name in columns):
                return index + place
        index = last
    return None if counts[0] == counts[1] else end
