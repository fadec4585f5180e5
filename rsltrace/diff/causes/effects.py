"""What differs so that one can see it. That a node was set up with another parameter is no effect
yet: what it then does is."""

from __future__ import annotations

from collections.abc import Callable

from rsltrace.diff.alignment.blocks import AlignedBlock, EventPair
from rsltrace.diff.alignment.rows import CONSTRUCT, SHUTDOWN
from rsltrace.diff.causes.propagation import (
    DivergenceOrigin,
    FoundDivergence,
    Propagation,
    outputs_of_one,
)
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.operation import PARAMETER_EVENTS


def is_effect(block: AlignedBlock, item: EventPair) -> bool:
    """Whether an item is more than a node that was set up differently.

    What a constructor logs or says on ``/parameter_events``, and the state of a node, are not.
    """
    if item.plain or item.beyond:
        return False
    a, b = block.rows_a, block.rows_b
    rows, index = (a, item.a) if item.a >= 0 else (b, item.b)
    place = index - rows.first
    keys = rows.run.matching.keys
    if rows.kind[place] == SHUTDOWN or keys[rows.number[place]].name == PARAMETER_EVENTS:
        return False
    if item.a < 0 or item.b < 0 or item.inverted:
        return True
    i, j = item.a - a.first, item.b - b.first
    if (a.stamp[i], a.input[i], a.flags[i]) != (b.stamp[j], b.input[j], b.flags[j]):
        return True
    if rows.kind[place] != CONSTRUCT:
        return bool(outputs_of_one(block, item))
    return any(
        kind != OutputKind.LOG and keys[number].name != PARAMETER_EVENTS
        for kind, number, _, _ in outputs_of_one(block, item)
    )


def is_setup(block: AlignedBlock, item: EventPair) -> bool:
    """Whether an item is a node that was set up differently, and no effect yet."""
    if item.plain or item.beyond or is_effect(block, item):
        return False
    rows, index = (block.rows_a, item.a) if item.a >= 0 else (block.rows_b, item.b)
    return rows.kind[index - rows.first] == CONSTRUCT or bool(outputs_of_one(block, item))


class EffectSearch:
    """Looks through blocks, after ``Propagation`` took each, for what is to be shown first.

    If the first divergence is a node set up differently that is the first effect of this. If all of
    it is ``covered`` (ignored, or within tolerance) it is the first difference that is not.
    ``found`` is None as long as there is nothing to show but the first divergence.
    """

    def __init__(self, covered: Callable[[EventPair], bool] | None) -> None:
        self.found: FoundDivergence | None = None
        self.past_covered = False
        self._covered = covered
        self._setups: set[int] = set()
        self._roots = 0

    @property
    def going_on(self) -> bool:
        """Whether there may be something in a later block."""
        return self.found is None and (self.past_covered or 0 in self._setups)

    @property
    def in_vain(self) -> bool:
        """Whether nothing was found that a node set up differently has led to."""
        return self.found is None and not self.past_covered and 0 in self._setups

    def take(self, block: AlignedBlock, propagation: Propagation) -> None:
        if self._roots and not self.going_on:
            return
        first = not self._roots
        for number in range(self._roots, len(propagation.found)):
            item = propagation.found[number].origin.item
            if is_setup(block, item):
                self._setups.add(number)
        self._roots = len(propagation.found)
        if first and self._covered is not None:
            self.past_covered = self._covered(propagation.found[0].origin.item)
        if not self.going_on:
            return
        for item in sorted(
            (item for item in block.items if is_effect(block, item)),
            key=lambda item: _order(block, item),
        ):
            origin = propagation.origin_of(item)
            if origin is not None and self._is_wanted(item, origin):
                self.found = propagation.found_at(item, origin)
                return

    def _is_wanted(self, item: EventPair, origin: DivergenceOrigin) -> bool:
        if self._covered is not None and self._covered(item):
            return False
        return self.past_covered or origin.root in self._setups


def first_effect(block: AlignedBlock) -> EventPair | None:
    """Return the first effect of a block, in whichever run it comes first; None if it has none."""
    found = (item for item in block.items if is_effect(block, item))
    return min(found, key=lambda item: _order(block, item), default=None)


def _order(block: AlignedBlock, item: EventPair) -> tuple[int, bool, int, str]:
    stamps, indexes, name = [], [], ""
    for rows, index in ((block.rows_a, item.a), (block.rows_b, item.b)):
        if index >= 0:
            place = index - rows.first
            stamps.append(rows.times[place])
            indexes.append(index)
            name = str(rows.run.matching.keys[rows.number[place]])
    return min(stamps), len(indexes) == 2 and not item.inverted, min(indexes), name
