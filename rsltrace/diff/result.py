"""The answers: what a diff found, with its sentences. A report needs no file for them any more.

``a`` is always the first file given, ``b`` the second. Stamps are simulated nanoseconds, hashes
unsigned 64-bit. Sentences are made on demand; nothing is decided by them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rsltrace.diff.facts.bags import BagComparison, NativeComparison
from rsltrace.diff.facts.causes import CallbackAbsence, Judgement, PossibleCause, Verdict
from rsltrace.diff.facts.evidence import AffectedTopic, CallDifference, CauseStep, EventRow, Setting
from rsltrace.diff.facts.remarks import Outcome, Remark, RepeatedRun, Repeats, TruncatedRecording
from rsltrace.diff.options import EXIT_DIVERGED, EXIT_WITHIN_TOLERANCE
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace

if TYPE_CHECKING:
    from rsltrace.trace.words.entities import EntityKey


@dataclass(frozen=True, slots=True)
class Divergence(Judgement):
    """One place where the runs diverge. ``independent`` ones follow from no earlier one.

    ``chain`` is the way from the root to it. ``rows`` are the last rows before it and its own,
    ``node_rows`` the last before it in the same node. ``next_step`` is a command that shows or
    reproduces the place, in the viewer if ``next_opens_viewer``. ``absence`` is why a callback that
    only one run has did not come in the other, if that is known.
    """

    chain: tuple[CauseStep, ...] = ()
    rows: tuple[EventRow, ...] = ()
    node_rows: tuple[EventRow, ...] = ()
    reaches: tuple[AffectedTopic, ...] = ()
    next_step: str = ""
    next_opens_viewer: bool = False
    calls: tuple[CallDifference, ...] = ()
    absence: CallbackAbsence | None = None

    @property
    def sentence(self) -> str:
        """What happened."""
        from rsltrace.diff.sentences.divergence import sentence_of

        return sentence_of(self)

    @property
    def root_sentence(self) -> str:
        """Where it comes from; for most verdicts that is the diverging event itself."""
        from rsltrace.diff.sentences.divergence import cause_of

        return cause_of(self)

    @property
    def likely_cause(self) -> str:
        """What came from outside and explains it, "" if nothing is known."""
        from rsltrace.diff.sentences import sentence

        if self.likely is None or isinstance(self.likely, PossibleCause):
            return ""
        return sentence(self.likely)


@dataclass(frozen=True, slots=True)
class BagDiff(BagComparison):
    """The answer for two recordings, with its sentences."""

    @property
    def sentence(self) -> str:
        """The answer."""
        from rsltrace.diff.sentences.runs import recordings_sentence

        return recordings_sentence(self)

    @property
    def notes(self) -> tuple[str, ...]:
        """What else to know of the comparison."""
        return _notes(self.remarks)


def _notes(remarks: tuple[Remark, ...]) -> tuple[str, ...]:
    from rsltrace.diff.sentences.runs import remark_text

    return tuple(remark_text(remark) for remark in remarks)


@dataclass(frozen=True, slots=True)
class EntityCount:
    """How the events of one entity compare, over the part of the runs that was aligned."""

    entity: EntityKey
    matching: int
    differing: int
    only_a: int
    only_b: int


@dataclass(frozen=True, slots=True)
class ComparedRun:
    """One of the two files."""

    path: str
    digest: str
    events: int
    end_ns: int
    complete: bool
    stop_reason: str = ""


@dataclass(frozen=True, slots=True)
class Diff:
    """The answer. ``exit_code``: 0 identical, 1 not, 3 equal within tolerance.

    ``verdict`` is that of the first divergence, ``outcome`` what is said of both runs as a whole.
    ``effect`` is the first difference that is more than a node that was set up differently (other
    parameters), if the first divergence is no more than that.
    ``agreeing`` is how many events are the same before the first divergence. ``settings`` lists
    what differs in job and environment. ``counts`` and ``resync_index`` (indexes in a and b from
    which on the runs agree again, if they do) cover the events from the divergence to
    ``aligned_to`` (indexes in a and b; all of both with ``--all``).
    ``tolerance`` compares all messages of both runs, if tolerances were given and no event is
    missing, extra or at another time; else it is None.
    """

    a: ComparedRun
    b: ComparedRun
    verdict: Verdict
    outcome: Outcome
    agreeing: int
    divergences: tuple[Divergence, ...] = ()
    settings: tuple[Setting, ...] = ()
    counts: tuple[EntityCount, ...] = ()
    resync_index: tuple[int, int] | None = None
    aligned_to: tuple[int, int] = (0, 0)
    bytes_read: int = 0
    remarks: tuple[Remark, ...] = ()
    tolerance: BagDiff | None = None
    allow_truncated: bool = False
    """Whether truncated recordings are accepted."""

    effect: Divergence | None = None

    native: NativeComparison | None = None
    """What of the difference is content, order and timing, if a run is native. Events are not
    aligned then."""

    @property
    def sentence(self) -> str:
        """The answer: the settings that can be the cause, and their effect."""
        from rsltrace.diff.sentences.runs import answer

        return answer(self)

    @property
    def notes(self) -> tuple[str, ...]:
        """What else to know of the comparison."""
        return _notes(self.remarks)

    @property
    def shown(self) -> Divergence | None:
        """What a report shows first: the first effect, or else the first divergence."""
        return self.effect or (self.divergences[0] if self.divergences else None)

    @property
    def identical(self) -> bool:
        """Whether the two runs did the same."""
        return self.verdict is Verdict.IDENTICAL

    @property
    def agrees_until_cut(self) -> bool:
        """Whether a recording is cut, and the runs agree as far as both go."""
        return self.verdict is Verdict.AGREE_UNTIL_TRUNCATED

    @property
    def within_tolerance(self) -> bool:
        """Whether the runs are not identical, but every message is within what is tolerated."""
        if self.native is not None:
            return self.verdict is Verdict.SAME_CONTENT
        return self.tolerance is not None and not self.tolerance.diverged

    @property
    def diverged(self) -> bool:
        """Whether the runs did not do the same, and not even within tolerance."""
        return not (self.identical or self.agrees_until_cut or self.within_tolerance)

    @property
    def failed(self) -> bool:
        """Whether a test that compares the runs fails: they diverge, or one is cut."""
        return self.exit_code == EXIT_DIVERGED

    @property
    def exit_code(self) -> int:
        """0 identical, 1 diverged or cut, 3 equal within tolerance; trouble is raised instead.

        Where one recording has no event at all nothing agrees, whatever the options.
        """
        if self.identical:
            return 0
        if self.agrees_until_cut:
            agrees = self.agreeing or (self.native is not None and self.native.compared)
            return 0 if self.allow_truncated and agrees else EXIT_DIVERGED
        return EXIT_WITHIN_TOLERANCE if self.within_tolerance else EXIT_DIVERGED

    def _repr_html_(self) -> str:
        """Return what a notebook shows of it."""
        from rsltrace.trace.model.html import HtmlSheet
        from rsltrace.trace.model.texts import format_seconds
        from rsltrace.trace.words.phrases import as_sentence

        sheet = HtmlSheet(as_sentence(self.sentence))
        sheet.line(f"{self.verdict.value}; the first {self.agreeing} events agree")
        sheet.table(
            ("", "trace", "events", "ends at", "digest", "stopped by"),
            (
                (name, s.path, s.events, f"{format_seconds(s.end_ns)} s", s.digest, s.stop_reason)
                for name, s in (("a", self.a), ("b", self.b))
            ),
        )
        if (shown := self.shown) is None:
            return sheet.html()
        sheet.table(
            ("", "topic", "field", "a", "b"),
            (
                ("input" if m.position < 0 else f"output {m.position}", m.topic, f.path, f.a, f.b)
                for m in shown.messages
                for f in m.fields
            ),
        )
        if shown.root_sentence:
            sheet.line(f"cause: {shown.root_sentence}")
        sheet.table(("reaches", "after"), ((r.topic, f"{r.after_ns} ns") for r in shown.reaches))
        if shown.next_step:
            sheet.line(f"next: {shown.next_step}")
        return sheet.html()


@dataclass(frozen=True, slots=True)
class Reproduction(RepeatedRun):
    """Which of two runs that diverge a third one repeats, with its sentence."""

    @property
    def sentence(self) -> str:
        """The answer in words."""
        from rsltrace.diff.sentences.runs import reproduction_text

        return reproduction_text(self)

    @property
    def exit_code(self) -> int:
        """0 if one of the runs was repeated, 1 if not."""
        return 0 if self.repeats in (Repeats.A, Repeats.B) else 1


# What there is to know of each of the two runs as a whole.


def stop_reason(trace: Trace) -> str:
    if not trace.complete:
        return "interrupted"
    return trace.result.get("stop_reason") or "no reason given"


def side(trace: Trace) -> ComparedRun:
    """Return what there is to know of a run as a whole."""
    return ComparedRun(
        path=trace.name,
        digest="" if is_native(trace) else trace.digest,
        events=trace.event_count,
        end_ns=trace.stamp(trace.end_ns),
        complete=trace.complete,
        stop_reason=stop_reason(trace),
    )


def interruptions(a: Trace, b: Trace) -> list[Remark]:
    """Return a remark for each run whose recording was cut off."""
    return [
        TruncatedRecording(name, trace.name, trace.event_count, trace.end_ns)
        for name, trace in (("a", a), ("b", b))
        if not trace.complete
    ]
