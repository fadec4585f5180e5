"""One divergence with everything there is to know of it: verdict, way from the root, evidence."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import field, fields, replace
from typing import Any

import numpy as np

from rsltrace.diff.alignment.aligned_rows import AlignedRows
from rsltrace.diff.alignment.blocks import EventPair
from rsltrace.diff.alignment.rows import ComparedTrace, outputs_of
from rsltrace.diff.causes.calls import call_differences
from rsltrace.diff.causes.classify import ROOT_OF, DivergenceCase, judge
from rsltrace.diff.causes.delivery import (
    are_swapped,
    entity_changes,
    lost_message,
    periods,
    slept,
    still_waits,
    topics_of,
)
from rsltrace.diff.causes.event_views import EventViews
from rsltrace.diff.causes.likely_cause import changed_properties, likely_cause, suppressed_exception
from rsltrace.diff.causes.message_differences import message_differences
from rsltrace.diff.causes.propagation import (
    BUSY,
    DRAWN,
    MADE,
    NODE,
    STUCK,
    DivergenceOrigin,
    FoundDivergence,
)
from rsltrace.diff.causes.record_command import record_again
from rsltrace.diff.causes.relevance import Relevance
from rsltrace.diff.causes.state_differences import state_differences
from rsltrace.diff.facts.causes import (
    CallbackAbsence,
    Consequence,
    Judgement,
    Root,
    SameCause,
    UnguardedCall,
    Verdict,
)
from rsltrace.diff.facts.evidence import (
    AffectedTopic,
    CauseLink,
    CauseLinkKind,
    CauseStep,
    EntityChanges,
    EventRow,
    EventSummary,
    MessageDifference,
    Setting,
    SettingKind,
)
from rsltrace.diff.facts.remarks import Remark
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import Divergence
from rsltrace.diff.row_sign import RowSign
from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventKind, OutputKind
from rsltrace.trace.model.operation import PARAMETER_EVENTS
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.phrases import path_word, seconds_text

_EXPLAINED_EVENTS_MAX = 250_000
"""Events and outputs of runs that are looked through, in all, for why callbacks did not come."""

ANCESTORS_MAX = 5
"""Events shown that led to a root. Both runs have them."""

STEPS_MAX = 16
"""Steps shown between a root and its consequence; of more, the last ones."""


@dataclass
class Explainer:
    """Puts divergences in words. ``found`` are all roots so far, by number."""

    run_a: ComparedTrace
    run_b: ComparedTrace
    options: DiffOptions
    settings: Sequence[Setting]
    found: Sequence[FoundDivergence]
    rows: AlignedRows
    _judged: dict[int, Judgement] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._viewer_a = EventViews(self.run_a)
        self._viewer_b = EventViews(self.run_b)
        self._relevance = Relevance(self.run_a, self.run_b)
        self._left_to_explain = _EXPLAINED_EVENTS_MAX
        self.warnings: dict[Remark, None] = {}
        """What to know before one runs a ``next_step``."""

    def explain(self, found: FoundDivergence) -> Divergence:
        """Return everything about a root, or about a selected consequence."""
        a, b, messages = self._differing(found)
        judgement = self._judge(found, a, b, messages)
        if found.origin.previous is not None:
            judgement = self._following(judgement, found.origin)
        return self._divergence(found, judgement)

    def explain_effect(self, found: FoundDivergence, first: Divergence) -> Divergence:
        """Return everything about the first effect of a node that was set up differently."""
        effect, runs = self.explain(found), (self.run_a, self.run_b)
        root = self._root_judgement(found.origin.root)
        return replace(
            effect,
            root=ROOT_OF.get(root.verdict, root.root),
            why=SameCause(first),
            likely=suppressed_exception(effect, runs) or changed_properties(effect, runs),
            settings=root.settings,
            reaches=tuple(r for r in effect.reaches if r.topic != PARAMETER_EVENTS),
            next_step=first.next_step,
            next_opens_viewer=first.next_opens_viewer,
        )

    def is_covered(self, item: EventPair) -> bool:
        """Whether all that differs in an item is ignored or within tolerance."""
        a, b = self.view(item.a, of_b=False), self.view(item.b, of_b=True)
        if a is None or b is None or (a.stamp_ns, a.flags) != (b.stamp_ns, b.flags):
            return False
        found = message_differences(self.run_a, self.run_b, a, b, self.options)
        return bool(found) and all(message.is_covered for message in found)

    def ended(self, index: int, judgement: Judgement) -> Divergence:
        """Return a divergence at ``index`` where one run has nothing more to compare."""
        bare = _divergence_of(
            judgement,
            chain=(CauseStep(judgement.a, judgement.b),),
            next_step=self._next_step(judgement),
            next_opens_viewer=self._opens_viewer(judgement),
        )
        return self._with_context(bare, index, index)

    def alone(self, index: int, *, of_b: bool) -> Judgement | None:
        """Return the verdict on an event that the other run, which is over, does not have; None if
        its own run is over there, too."""
        view = self.view(index, of_b=of_b)
        if view is None or view.kind is EventKind.SHUTDOWN:
            return None
        item = EventPair(-1 if of_b else index, index if of_b else -1, same=False)
        origin = DivergenceOrigin(item, root=0, why=None, previous=None)
        found = FoundDivergence(origin, view.stamp_ns, item.a, item.b)
        return self._judge(found, *self._differing(found))

    def view(self, index: int, *, of_b: bool) -> EventSummary | None:
        """Return an event of one of the runs, or None if it has none of that index."""
        run, viewer = (self.run_b, self._viewer_b) if of_b else (self.run_a, self._viewer_a)
        return viewer.view(index) if 0 <= index < run.trace.event_count else None

    # -- the verdict ---------------------------------------------------------------------------

    def _differing(
        self, found: FoundDivergence
    ) -> tuple[EventSummary | None, EventSummary | None, tuple[MessageDifference, ...]]:
        item = found.origin.item
        a, b = self.view(item.a, of_b=False), self.view(item.b, of_b=True)
        other_a, other_b = (
            self.view(found.place_a, of_b=False),
            self.view(found.place_b, of_b=True),
        )
        if other_a is not None and other_b is not None:
            renamed = _is_renamed(self, other_a, other_b)
            if renamed or (None in (a, b) and _is_reordered(self, other_a, other_b)):
                return other_a, other_b, ()
        return a, b, message_differences(self.run_a, self.run_b, a, b, self.options)

    def _judge(
        self,
        found: FoundDivergence,
        a: EventSummary | None,
        b: EventSummary | None,
        messages: tuple[MessageDifference, ...],
    ) -> Judgement:
        return judge(
            DivergenceCase(
                a=a,
                b=b,
                other_a=self.view(found.place_a, of_b=False),
                other_b=self.view(found.place_b, of_b=True),
                cause_a=self.view(_cause(a), of_b=False),
                cause_b=self.view(_cause(b), of_b=True),
                inverted=found.origin.item.inverted,
                cause_only=found.cause_only,
                why=found.origin.why,
                messages=messages,
                settings=self.settings,
                relevance=self._relevance,
                state=state_differences(self.run_a, self.run_b, a, b),
                loss=still_waits(self.run_a, self.run_b, a, b)
                or lost_message(self.run_a, self.run_b, a, b),
                periods_ns=periods(self.run_a, self.run_b, a, b),
                slept=slept(self.run_a, self.run_b, a, b),
                changed=self._changed(a or b, messages),
                reordered=a is not None and b is not None and _is_reordered(self, a, b),
                swapped=are_swapped(self.run_a, self.run_b, a, b),
            )
        )

    def _changed(
        self, view: EventSummary | None, messages: Sequence[MessageDifference]
    ) -> EntityChanges | None:
        """Return the entities whose QoS shows in an event."""
        if view is None or not (topics := topics_of(view, messages)):
            return None
        return entity_changes(self.run_a, self.run_b, topics)

    def _root_judgement(self, number: int) -> Judgement:
        if number not in self._judged:
            found = self.found[number]
            self._judged[number] = self._judge(found, *self._differing(found))
        return self._judged[number]

    def _following(self, judgement: Judgement, origin: DivergenceOrigin) -> Judgement:
        """Return the verdict on a consequence: its own, with the root of its divergence."""
        root = self._root_judgement(origin.root)
        return replace(
            judgement,
            root=ROOT_OF.get(root.verdict, root.root),
            why=Consequence(root),
            node_diverged=origin.why == NODE
            and judgement.verdict is Verdict.SAME_INPUT_DIFFERENT_OUTPUT,
        )

    # -- the way from the root -------------------------------------------------------------------

    def _chain(self, found: FoundDivergence) -> tuple[CauseStep, ...]:
        origins = [found.origin]
        while (previous := origins[-1].previous) is not None:
            origins.append(previous)
        origins.reverse()
        steps = []
        for origin, following in zip(origins, [*origins[1:], None], strict=True):
            link = CauseLink()
            if following is not None and following.why == NODE:
                item = following.item
                view = self.view(item.a, of_b=False) or self.view(item.b, of_b=True)
                link = CauseLink(CauseLinkKind.CHANGED_STATE, view.entity.node) if view else link
            elif following is not None and following.why in _SHARED:
                link = CauseLink(_SHARED[following.why])
            elif following is not None:
                link = self._sent(following)
            a = self.view(origin.item.a, of_b=False)
            b = self.view(origin.item.b, of_b=True)
            steps.append(CauseStep(a, b, link))
        if len(steps) > STEPS_MAX:
            left_out = len(steps) - STEPS_MAX
            steps[1 : 1 + left_out] = []
            steps[0] = replace(steps[0], link=CauseLink(CauseLinkKind.MORE_STEPS, steps=left_out))
        return (*self._ancestors(origins[0]), *steps)

    def _ancestors(self, root: DivergenceOrigin) -> list[CauseStep]:
        """Return what led to a root, as far as both runs have it."""
        steps: list[CauseStep] = []
        item = root.item
        of_b = item.a < 0
        view = self.view(item.b if of_b else item.a, of_b=of_b)
        start = min(found.origin.item.a for found in self.found[:1])
        while view is not None and len(steps) < ANCESTORS_MAX:
            cause = _cause(view)
            if not 0 <= cause < min(view.index, start if start >= 0 else view.index):
                break
            link = self._link(self.run_b if of_b else self.run_a, cause, view.cause_output)
            a, b = self.view(cause, of_b=False), self.view(cause, of_b=True)
            steps.append(CauseStep(a, b, link))
            view = a
        return steps[::-1]

    def _sent(self, origin: DivergenceOrigin) -> CauseLink:
        """Say how the cause of an event led to it."""
        item = origin.item
        for run, index in ((self.run_a, item.a), (self.run_b, item.b)):
            if index >= 0:
                event = run.trace.event(index)
                if event.cause_event != NO_EVENT:
                    return self._link(run, event.cause_event, event.cause_output)
        return CauseLink()

    def _link(self, run: ComparedTrace, cause: int, nth: int) -> CauseLink:
        outputs = outputs_of(run, cause)
        if nth >= len(outputs):
            return CauseLink(CauseLinkKind.CAUSED)
        kind, number, _, _ = outputs[nth]
        return CauseLink(_LINKS.get(kind, CauseLinkKind.CAUSED), run.matching.keys[number].name)

    # -- the rest --------------------------------------------------------------------------------

    def _divergence(self, found: FoundDivergence, judgement: Judgement) -> Divergence:
        place_a = judgement.a.index if judgement.a is not None else found.place_a
        place_b = judgement.b.index if judgement.b is not None else found.place_b
        changed = judgement.changed
        node = "" if changed is None else changed.node
        calls = call_differences(self.run_a, self.run_b, judgement.a, judgement.b, node)
        if found.origin.previous is None:
            runs = self.run_a, self.run_b
            likely = likely_cause(judgement, runs, calls, self._relevance)
            judgement = replace(judgement, likely=likely)
        bare = _divergence_of(
            judgement,
            chain=self._chain(found),
            calls=calls,
            reaches=self._reaches(found),
            next_step=self._next_step(judgement),
            next_opens_viewer=self._opens_viewer(judgement),
            absence=self._absence(judgement),
        )
        return self._with_context(bare, place_a, place_b)

    def _with_context(self, bare: Divergence, place_a: int, place_b: int) -> Divergence:
        """Add the rows up to the divergence, and its own, also of an event that moved."""
        count, rows = self.options.context, self.rows
        if not count:
            return bare
        sides = (bare.a, place_a, self._viewer_a, False), (bare.b, place_b, self._viewer_b, True)
        own = [rows.place_of(view.index, of_b=of_b) for view, _, _, of_b in sides if view]
        own = own or [min(rows.place_of(place, of_b=of_b) for _, place, _, of_b in sides)]
        first = min(own)
        own += [there for place in own if (there := self._moved_to(place)) is not None]
        last = min(max(own) + 1, first + max(count, 2), rows.count)
        some = bare.a or bare.b
        node = self.run_a.matching.node_number(some.entity) if some is not None else 0
        of_node: set[int] = set()
        for _, place, viewer, of_b in sides:
            found = np.array(viewer.before_in_node(place, count, node), dtype=np.int64)
            of_node.update(rows.places_of(found, of_b=of_b).tolist())
        before = sorted(place for place in of_node if place < first)[-count:]
        return replace(
            bare,
            rows=self._rows(range(max(min(own) - count, 0), last)),
            node_rows=self._rows(before),
        )

    def _moved_to(self, place: int) -> int | None:
        """Return the other row of an event that moved."""
        if place >= self.rows.count:
            return None
        row = self.rows.row(place)
        if row.elsewhere is None:
            return None
        return self.rows.place_of(row.elsewhere, of_b=row.b is None)

    def _rows(self, places: Iterable[int]) -> tuple[EventRow, ...]:
        found = []
        for place in places:
            row = self.rows.row(place)
            a, b = (
                None if index is None else self.view(index, of_b=of_b)
                for index, of_b in ((row.a, False), (row.b, True))
            )
            there = self._moved_to(place)
            found.append(
                EventRow(
                    a,
                    b,
                    row.sign,
                    row.elsewhere,
                    there is not None and there > place,
                    self._different_messages(*row.pair) if row.sign is RowSign.DIFFERS else (),
                )
            )
        return tuple(found)

    def _different_messages(self, a: int | None, b: int | None) -> tuple[MessageDifference, ...]:
        view_a = None if a is None else self.view(a, of_b=False)
        view_b = None if b is None else self.view(b, of_b=True)
        return message_differences(self.run_a, self.run_b, view_a, view_b, DiffOptions())

    def _reaches(self, found: FoundDivergence) -> tuple[AffectedTopic, ...]:
        keys = self.run_a.matching.keys
        topics: dict[str, tuple[int, int, int]] = {}
        for number, (first, count, moved) in found.reached.items():
            topic = keys[number].name
            earlier, so_far, by = topics.get(topic, (first, 0, moved))
            if (earlier, abs(by)) < (first, abs(moved)):
                first, moved = earlier, by
            topics[topic] = (first, so_far + count, moved)
        reaches = [
            AffectedTopic(topic, max(first - found.stamp, 0), count, moved)
            for topic, (first, count, moved) in topics.items()
            if self.options.wants_topic(topic)
        ]
        return tuple(sorted(reaches, key=lambda reach: (reach.after_ns, reach.topic)))

    def _has_other_settings(self, judgement: Judgement) -> bool:
        if judgement.verdict in (Verdict.ENDED_EARLY, Verdict.RAN_LONGER) or not self.settings:
            return False
        return judgement.verdict is Verdict.ENVIRONMENT or _told_to_differ(self.settings)

    def _opens_viewer(self, judgement: Judgement) -> bool:
        """Return whether the next step is a look at both runs; the viewer opens no addresses."""
        is_remote = any("://" in run.trace.name for run in (self.run_a, self.run_b))
        return self._has_other_settings(judgement) and not is_remote

    def _next_step(self, judgement: Judgement) -> str:
        view = judgement.a or judgement.b
        assert view is not None
        path_a, path_b = (path_word(run.trace.name) for run in (self.run_a, self.run_b))
        verdict = judgement.verdict
        if isinstance(judgement.likely, UnguardedCall):
            return f"rsltrace audit {path_word(judgement.likely.file)}"
        if verdict in (Verdict.ENDED_EARLY, Verdict.RAN_LONGER):
            return f"rsltrace info {path_b if verdict is Verdict.ENDED_EARLY else path_a}"
        if self._opens_viewer(judgement):
            return f"rsltrace view {path_a} {path_b}"
        if self._has_other_settings(judgement):
            return f"rsltrace diff {path_a} {path_b} --all"
        lacking = self._lacks_callback(judgement)
        is_in_one = lacking is None and judgement.root in (Root.MISSING, Root.EXTRA)
        if judgement.root in _AGAIN or is_in_one:
            record = record_again(self.run_a.trace)
            self.warnings.update(dict.fromkeys(record.warnings))
            if record.command:
                last = max(v.stamp_ns for v in (judgement.a, judgement.b) if v is not None)
                until = seconds_text(self.run_a.trace.stamp(last))
                again = f"{record.command} --until {until} -o again.mcap --force"
                return f"{again}; rsltrace diff {path_a} {path_b} --again again.mcap"
        if lacking is not None:
            name = shlex.quote(view.entity.name)
            since = seconds_text(lacking.stamp(view.stamp_ns))
            of = f"{path_word(lacking.name)} {shlex.quote(view.entity.node)} {name}"
            return f"rsltrace why {of} --at {since}"
        path = path_a if judgement.a is not None else path_b
        time = seconds_text(view.stamp_ns)
        node = view.entity.node
        choice = f" --node {shlex.quote(node)}" if node and view.kind is not EventKind.BAG else ""
        if view.kind is EventKind.BAG:
            choice = f" --topic {shlex.quote(view.entity.name)}"
        if view.kind is EventKind.CONSTRUCT:
            choice = " --kind construct"
        return f"rsltrace cat {path}{choice} --from {time} --to {time} --json --payloads"

    def _lacks_callback(self, judgement: Judgement) -> Trace | None:
        """Return the run that lacks a callback of an entity that both have, None if none does."""
        view, matching = judgement.one, self.run_a.matching
        if view is None or (judgement.a is not None and judgement.b is not None):
            return None
        alone = matching.by_key[view.entity] in {*matching.only_a, *matching.only_b}
        if alone or view.entity.ordinal or view.entity.kind not in _EXPLAINED:
            return None
        return (self.run_a if judgement.a is None else self.run_b).trace

    def _absence(self, judgement: Judgement) -> CallbackAbsence | None:
        """Return why a run lacks a callback, unless that is unknown or takes too long to find."""
        view, trace = judgement.one, self._lacks_callback(judgement)
        if view is None or trace is None or "://" in trace.name:
            return None
        self._left_to_explain -= trace.event_count + trace.output_count
        if self._left_to_explain < 0:
            return None
        from rsltrace.diff.why.answer import why  # most diffs need none of it

        try:
            reason = why(trace, view.entity.node, view.entity.name, view.stamp_ns)
        except TraceError:
            return None
        if not reason.is_reason:
            return None
        run = "a" if judgement.a is None else "b"
        return CallbackAbsence(run, reason.kind, reason.words(), reason.place, reason.event)


def _told_to_differ(settings: Sequence[Setting]) -> bool:
    """Whether job or code are others in the two runs: that needs no third run to be believed."""
    return any(setting.kind is not SettingKind.ENVIRONMENT for setting in settings)


def _is_renamed(explainer: Explainer, a: EventSummary, b: EventSummary) -> bool:
    """Whether two constructors make the same node under different names."""
    if not a.kind is b.kind is EventKind.CONSTRUCT or a.entity.type != b.entity.type:
        return False
    matching = explainer.run_a.matching
    alone_a = matching.by_key[a.entity] in matching.only_a
    return bool(a.entity.type) and alone_a and matching.by_key[b.entity] in matching.only_b


def _is_reordered(explainer: Explainer, a: EventSummary, b: EventSummary) -> bool:
    """Whether two mains begin with different nodes that both runs have."""
    if not a.kind is b.kind is EventKind.CONSTRUCT or a.entity == b.entity:
        return False
    matching = explainer.run_a.matching
    alone = {*matching.only_a, *matching.only_b}
    return not alone & {matching.by_key[one.entity] for one in (a, b)}


_SHARED = {
    DRAWN: CauseLinkKind.DRAWN_AGAIN,
    MADE: CauseLinkKind.MADE_RECEIVER,
    BUSY: CauseLinkKind.KEEPS_WAITING,
    STUCK: CauseLinkKind.ENDED_BEFORE,
}

_EXPLAINED = frozenset(
    kind.label
    for kind in (EntityKind.SUBSCRIPTION, EntityKind.TIMER, EntityKind.SERVICE, EntityKind.CLIENT)
)
"""Kinds of entities whose callbacks `rsltrace why` is asked about."""

_AGAIN = frozenset((Root.CALLBACK, Root.SCHEDULE, Root.TIMING, Root.EXCEPTION, Root.JOB))
"""Roots of which recording the job again helps: it shows which run is the usual one."""

_LINKS: dict[int, CauseLinkKind] = {
    OutputKind.MESSAGE: CauseLinkKind.PUBLISHED,
    OutputKind.REQUEST: CauseLinkKind.CALLED,
    OutputKind.RESPONSE: CauseLinkKind.ANSWERED,
    OutputKind.LOG: CauseLinkKind.LOGGED,
    OutputKind.GUARD: CauseLinkKind.TRIGGERED,
    OutputKind.TASK: CauseLinkKind.MADE_TASK,
}


def _divergence_of(judgement: Judgement, **more: Any) -> Divergence:
    own = {field.name: getattr(judgement, field.name) for field in fields(judgement)}
    return Divergence(**own, **more)


def _cause(view: EventSummary | None) -> int:
    """Return the index of an event's cause, -1 if it has none."""
    return -1 if view is None or view.cause_event == NO_EVENT else view.cause_event
