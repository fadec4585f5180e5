"""What a diff of two traces says. A report prints it without opening the files again.

``a`` is always the first file given, ``b`` the second. Stamps are simulated nanoseconds, hashes
unsigned 64-bit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rsltrace.diff.result.exit_codes import EXIT_DIVERGED, EXIT_WITHIN_TOLERANCE
from rsltrace.diff.result.settings import Setting
from rsltrace.diff.result.verdicts import Verdict

if TYPE_CHECKING:  # most runs are identical: their diff loads no more than it needs
    from rsltrace.diff.result.bags import BagDiff
    from rsltrace.diff.result.divergence import Divergence
    from rsltrace.diff.result.native import NativeComparison
    from rsltrace.words.entities import EntityKey


@dataclass(frozen=True, slots=True)
class EntityCount:
    """How the events of one entity compare, over the part of the runs that was aligned."""

    entity: EntityKey
    matching: int
    differing: int
    only_a: int
    only_b: int


@dataclass(frozen=True, slots=True)
class Side:
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

    ``verdict`` is that of the first divergence, ``sentence`` what a person wants to know of it: the
    settings that are to blame, and what they did. ``effect`` is the first difference that is more
    than a node set up otherwise (other parameters), if the first divergence is no more than that.
    ``agreeing`` is how many events are the same before the first divergence. ``settings`` lists
    what differs in job and environment. ``counts`` and ``resync_index`` (indexes in a and b from
    which on the runs agree again, if they do) cover the events from the divergence to
    ``aligned_to`` (indexes in a and b; all of both with ``--all``).
    ``tolerance`` compares all messages of both runs, if tolerances were given and no event is
    missing, extra or at another time; else it is None.
    """

    a: Side
    b: Side
    verdict: Verdict
    sentence: str
    agreeing: int
    divergences: tuple[Divergence, ...] = ()
    settings: tuple[Setting, ...] = ()
    counts: tuple[EntityCount, ...] = ()
    resync_index: tuple[int, int] | None = None
    aligned_to: tuple[int, int] = (0, 0)
    bytes_read: int = 0
    notes: tuple[str, ...] = field(default=())
    tolerance: BagDiff | None = None
    as_far_as_they_go: bool = False
    """Whether it is enough that they agree as far as they go."""

    effect: Divergence | None = None

    native: NativeComparison | None = None
    """What of the difference is content, order and timing, if a run is native. Events are not
    aligned then."""

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
        return self.verdict is Verdict.AS_FAR_AS_THEY_GO

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

        Where one recording has no event at all there is nothing that agrees, whatever was asked.
        """
        if self.identical:
            return 0
        if self.agrees_until_cut:
            agrees = self.agreeing or (self.native is not None and self.native.compared)
            return 0 if self.as_far_as_they_go and agrees else EXIT_DIVERGED
        return EXIT_WITHIN_TOLERANCE if self.within_tolerance else EXIT_DIVERGED

    def _repr_html_(self) -> str:
        """Return what a notebook shows of it."""
        from rsltrace.model.html import Sheet
        from rsltrace.model.stamp import format_seconds
        from rsltrace.words.phrases import as_sentence

        sheet = Sheet(as_sentence(self.sentence))
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
