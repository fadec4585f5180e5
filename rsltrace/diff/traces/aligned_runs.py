"""Two runs event by event: their aligned rows, and in what the two events of a row differ."""

from __future__ import annotations

from collections.abc import Iterator

from rsltrace.diff.alignment.aligned_rows import ALIGNED_MAX, AlignedRows
from rsltrace.diff.alignment.blocks import AlignedBlock, AlignedBlocks, EqualBlock
from rsltrace.diff.alignment.divergence import first_difference
from rsltrace.diff.alignment.entity_matching import match_entities
from rsltrace.diff.alignment.rows import ComparedTrace
from rsltrace.diff.causes.effects import first_effect, is_setup
from rsltrace.diff.causes.event_views import EventViews
from rsltrace.diff.causes.message_differences import message_differences
from rsltrace.diff.facts.evidence import EventSummary, MessageDifference
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.traces.comparison import first_item
from rsltrace.trace.reader import Trace

_EVENTS_PER_BLOCK = 2000

Block = AlignedBlock | EqualBlock


class AlignedRuns:
    """The rows of two traces. ``take(fetch())`` aligns another block; the first one is aligned."""

    def __init__(self, a: Trace, b: Trace) -> None:
        """Find the first difference and align the events around it. Raises TraceError."""
        first = first_difference(a, b)
        self.rows = AlignedRows(
            a.event_count, b.event_count, a.event_count if first is None else first
        )
        self.done = first is None
        self.first_place: int | None = first
        """The row of the first difference that is an effect; None if nothing differs."""
        self.matching = match_entities(a, b)
        self.run_a, self.run_b = (
            ComparedTrace(a, self.matching, False),
            ComparedTrace(b, self.matching, True),
        )
        self._views = EventViews(self.run_a), EventViews(self.run_b)
        self._blocks: Iterator[Block] = iter(())
        if first is None:
            return
        self._blocks = iter(
            AlignedBlocks(self.run_a, self.run_b, first, _EVENTS_PER_BLOCK, skip_equal=True)
        )
        block = self.fetch()
        self.take(block)
        if len(self.rows.divergences):
            self.first_place = int(self.rows.divergences[0])
        # If nodes were set up differently, show the first effect.
        if isinstance(block, AlignedBlock) and is_setup(block, first_item(block, first)):
            effect = first_effect(block)
            if effect is not None:
                index = effect.a if effect.a >= 0 else effect.b
                self.first_place = self.rows.place_of(index, of_b=effect.a < 0)

    def fetch(self) -> Block | None:
        """Match the next block without showing it yet, in any thread. Raises TraceError."""
        return next(self._blocks, None)

    def take(self, block: Block | None) -> None:
        if block is None:
            self.done = True
            return
        self.rows.take(block)
        at_end = isinstance(block, AlignedBlock) and block.at_end
        self.done = at_end or self.rows.matched > ALIGNED_MAX

    @property
    def progress(self) -> float:
        """The part of both runs that is aligned, 0 to 1."""
        return 1.0 if self.done else self.rows.progress

    def view(self, index: int, *, of_b: bool) -> EventSummary:
        """Return an event of a (``of_b``: of b) as reports tell it. Raises TraceError."""
        return self._views[of_b].view(index)

    def differences(self, a: int | None, b: int | None) -> tuple[MessageDifference, ...]:
        """Return the input and the outputs in which two events differ, with their values; of one
        event without a counterpart all. Raises TraceError."""
        view_a = self.view(a, of_b=False) if a is not None else None
        view_b = self.view(b, of_b=True) if b is not None else None
        return message_differences(self.run_a, self.run_b, view_a, view_b, DiffOptions())
