"""What follows from what: which of the differing events are consequences of an earlier one.

An event that differs is a consequence if what caused it differs (the message it received, the
event that made it) or if its node did something different before, since nobody sees into the state
of a node. What is neither is a divergence of its own. Every consequence remembers what it follows
from, so that the way back to the root can be told.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from rsltrace.diff.traces.rows import CONSTRUCT, SHUTDOWN, OutputRow, Rows
from rsltrace.diff.traces.stretches import Item, Stretch, mark_inverted
from rsltrace.model.event import NO_EVENT, OutputKind

CAUSE = "cause"
NODE = "node"
REACHING = frozenset((OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE))

UNDECIDED = -1
_DRAW = int(OutputKind.DRAW)

_REMEMBERED_MAX = 50_000
_DEPTH_MAX = 100
"""Steps of a way back that are kept."""


@dataclass(slots=True)
class Mark:
    """Why an event differs. ``root`` is the number of the divergence it follows from (or is), or
    UNDECIDED until the end of the instant.

    ``why`` is ``cause`` or ``node``, and ``previous`` the mark of the event it follows from that
    way; None for a root. ``depth`` counts the steps back to it.
    """

    item: Item
    root: int
    why: str | None
    previous: Mark | None
    depth: int = 0


@dataclass(slots=True)
class Found:
    """A divergence before it is put in words.

    ``place_a`` and ``place_b`` say where it stands in runs that have no such event. ``reached``
    holds for each publisher, client or service: first stamp, number of messages. ``cause_only`` is
    set where nothing but the cause differs. ``swapped`` are the entities that changed places.
    """

    mark: Mark
    stamp: int
    place_a: int
    place_b: int
    reached: dict[int, tuple[int, int]] = field(default_factory=dict)
    cause_only: bool = False
    swapped: frozenset[int] = frozenset()


class Cone:
    """Takes stretches in order and sorts differing events into roots and consequences.

    ``found`` are the roots, in order. ``watched`` is the first consequence for which ``watch``
    (a function of item and stretch) is true.
    """

    def __init__(self, watch: Callable[[Item, Stretch], bool] | None = None) -> None:
        self.found: list[Found] = []
        self.watched: Found | None = None
        self._watch = watch
        self._owners: dict[int, Mark] = {}
        self._marks_a: dict[int, Mark] = {}
        self._marks_b: dict[int, Mark] = {}
        self._stretch: Stretch
        self._moment: list[Mark] = []
        self._moment_stamp = -1
        self._inverted_in: dict[int, int] = {}

    def mark_of(self, item: Item) -> Mark | None:
        """Return why an item differs, if it does."""
        return self._marks_a.get(item.a) or self._marks_b.get(item.b)

    def take(self, stretch: Stretch, first: Item | None = None) -> None:
        """Go through a stretch. ``first``, if given, is the divergence the search has found: it
        is a root whatever else there is, and comes before everything."""
        self._stretch = stretch
        if first is not None:
            self._seed(first)
        for item in stretch.items:
            if not item.plain and not item.beyond and self.mark_of(item) is None:
                self._take_item(item)
        self._end_moment()
        self._forget(stretch)

    def _seed(self, first: Item) -> None:
        found = self._root(first)
        found.cause_only = first.plain
        if first.plain:
            return
        self._moment_stamp = found.stamp
        self._spread(first, found.mark)
        if first.inverted:
            # All that changed places at this instant is one divergence, and so is what follows.
            found.place_a = found.place_b = min(first.a, first.b)
            swapped = [
                item
                for item in self._stretch.items
                if item.inverted and self._stretch.stamp(item) == found.stamp
            ]
            found.swapped = self._entities(swapped)
            for item in swapped:
                if item is not first:
                    why, previous = self._explanation(item)
                    self._consequence(item, why, previous or found.mark)

    # -- one event -----------------------------------------------------------------------------

    def _take_item(self, item: Item) -> None:
        rows, index = self._rows(item)
        place = index - rows.first
        if rows.stamp[place] != self._moment_stamp:
            self._end_moment()
            self._moment_stamp = rows.stamp[place]
        why, previous = self._explanation(item)
        if previous is not None and previous.root == UNDECIDED and not item.same:
            self._end_moment()
            why, previous = self._explanation(item)
        if previous is not None and previous.root != UNDECIDED:
            self._consequence(item, why, previous)
        elif item.same:
            # It only changed places: with whom, and whether that was due to something, is known
            # when the instant is over.
            mark = Mark(item, UNDECIDED, why, previous)
            self._moment.append(mark)
            self._remember(item, mark)
        elif rows.kind[place] != SHUTDOWN:  # when the run ends is said elsewhere
            self._spread(item, self._root(item).mark)

    def _consequence(self, item: Item, why: str | None, previous: Mark) -> None:
        depth = previous.depth + 1
        if depth > _DEPTH_MAX:  # lets go of what lies further back
            why, previous, depth = None, self.found[previous.root].mark, 1
        mark = Mark(item, previous.root, why, previous, depth)
        self._remember(item, mark)
        self._spread(item, mark)
        if self._watch is not None and self.watched is None and self._watch(item, self._stretch):
            self.watched = Found(mark, self._stretch.stamp(item), *self._places(item))

    def _rows(self, item: Item) -> tuple[Rows, int]:
        if item.a >= 0:
            return self._stretch.rows_a, item.a
        return self._stretch.rows_b, item.b

    def _entities(self, items: list[Item]) -> frozenset[int]:
        rows = self._stretch.rows_a
        return frozenset(rows.number[item.a - rows.first] for item in items)

    def _root(self, item: Item) -> Found:
        mark = Mark(item, len(self.found), None, None)
        place_a, place_b = self._places(item)
        found = Found(mark, self._stretch.stamp(item), place_a, place_b)
        self.found.append(found)
        self._remember(item, mark)
        return found

    def _places(self, item: Item) -> tuple[int, int]:
        """Return the indexes of an item; where it is missing, of what follows it there."""
        stretch = self._stretch
        if item.a >= 0 and item.b >= 0:
            return item.a, item.b
        position = next(i for i, other in enumerate(stretch.items) if other is item)
        for other in stretch.items[position + 1 :]:
            if item.a < 0 and other.a >= 0:
                return other.a, item.b
            if item.b < 0 and other.b >= 0:
                return item.a, other.b
        return (stretch.end_a, item.b) if item.a < 0 else (item.a, stretch.end_b)

    def _remember(self, item: Item, mark: Mark) -> None:
        if item.a >= 0:
            self._marks_a[item.a] = mark
        if item.b >= 0:
            self._marks_b[item.b] = mark

    def _forget(self, stretch: Stretch) -> None:
        """Drop what lies before this stretch: a run that never agrees again has millions."""
        if len(self._marks_a) + len(self._marks_b) > _REMEMBERED_MAX:
            first_a, first_b = stretch.rows_a.first, stretch.rows_b.first
            self._marks_a = {i: mark for i, mark in self._marks_a.items() if i >= first_a}
            self._marks_b = {i: mark for i, mark in self._marks_b.items() if i >= first_b}

    def _end_moment(self) -> None:
        """Decide on what only changed places at the last instant, now that all of it is known."""
        moment, self._moment = self._moment, []
        self._inverted_in.clear()
        if not moment:
            return
        # Those that only changed places with a consequence were passed by it and did nothing.
        copies = [Item(mark.item.a, mark.item.b, True) for mark in moment]
        mark_inverted(copies)
        still = {copy.a: copy.b for copy in copies if copy.inverted}
        swapped = self._entities([mark.item for mark in moment if mark.item.a in still])
        # What decides between two that are due at once decides every time: that is one divergence.
        root = next((found for found in self.found if swapped and swapped <= found.swapped), None)
        for mark in moment:
            item = mark.item
            self._marks_a.pop(item.a, None)
            self._marks_b.pop(item.b, None)
            if item.a not in still:
                continue
            if root is None:
                root = self._root(item)
                root.place_a, root.place_b = min(still), min(still.values())
                root.swapped = swapped
                self._spread(item, root.mark)
            else:
                known = mark.previous and self.mark_of(mark.previous.item)
                self._consequence(item, mark.why if known else None, known or root.mark)

    # -- why -------------------------------------------------------------------------------------

    def _explanation(self, item: Item) -> tuple[str | None, Mark | None]:
        """Return what an item follows from: ``cause`` or ``node``, and the mark of that."""
        a, b = self._stretch.rows_a, self._stretch.rows_b
        rows, index = self._rows(item)
        place = index - rows.first
        by_node = None if rows.kind[place] == CONSTRUCT else self._owners.get(rows.owner[place])
        if item.a >= 0 and item.b >= 0 and not item.inverted:
            i, j = item.a - a.first, item.b - b.first
            if a.input[i] == b.input[j] and a.stamp[i] == b.stamp[j]:
                return (NODE, by_node) if by_node is not None else (None, None)
        for side, marks, at in ((a, self._marks_a, item.a), (b, self._marks_b, item.b)):
            if at < 0:
                continue
            cause = side.cause[at - side.first]
            mark = marks.get(cause) if cause != NO_EVENT else None
            if mark is not None and self._passes_on(mark, side, at, item):
                return CAUSE, mark
        return (NODE, by_node) if by_node is not None else (None, None)

    def _passes_on(self, mark: Mark, rows: Rows, at: int, item: Item) -> bool:
        """Whether the difference of a cause is one that the event it caused can have got.

        A message that is the same may still have had another delay.
        """
        cause = mark.item
        if cause.a < 0 or cause.b < 0:
            return True
        a, b = self._stretch.rows_a, self._stretch.rows_b
        if not a.first <= cause.a < a.end or not b.first <= cause.b < b.end:
            return True  # of an earlier stretch: not looked at again
        if a.stamp[cause.a - a.first] != b.stamp[cause.b - b.first]:
            return True
        if item.inverted and cause.inverted:
            return True
        nth = rows.cause_output[at - rows.first]
        mine, theirs = (cause.a, cause.b) if rows is a else (cause.b, cause.a)
        other = b if rows is a else a
        outputs = rows.outputs(mine)
        if nth >= len(outputs):
            return True
        receiver = rows.number[at - rows.first]
        if any(o[:2] == (_DRAW, receiver) for o in self._different_outputs(cause)):
            return True
        # Of equal outputs, the second has a counterpart only if the other run sent two.
        sent = outputs[nth][:3]
        before = sum(output[:3] == sent for output in outputs[: nth + 1])
        return before > sum(output[:3] == sent for output in other.outputs(theirs))

    # -- what follows ----------------------------------------------------------------------------

    def _spread(self, item: Item, mark: Mark) -> None:
        """Note whom a differing event reaches: its node, and the topics of what it sent."""
        rows, index = self._rows(item)
        place = index - rows.first
        owner = rows.owner[place]
        if item.same:
            # Changed places: its node notices only if it got two things in another order.
            self._inverted_in[owner] = self._inverted_in.get(owner, 0) + 1
            if self._inverted_in[owner] >= 2:
                self._taint(owner, mark)
            return
        outputs = self._different_outputs(item)
        nodes = rows.run.identity.nodes
        if not outputs or any(o[0] != _DRAW or nodes[o[1]] == o[1] for o in outputs):
            # What chance decides on the way leaves the sender as it was; its own clock does not.
            self._taint(owner, mark)
        found = self.found[mark.root]
        stamp = self._stretch.stamp(item)
        for kind, number, _, _ in outputs:
            if kind == OutputKind.ENTITY:  # the node may be one that only this run has
                self._taint(rows.run.identity.nodes[number], mark)
            elif kind in REACHING:
                first, count = found.reached.get(number, (stamp, 0))
                found.reached[number] = (min(first, stamp), count + 1)

    def _taint(self, owner: int, mark: Mark) -> None:
        if owner:
            self._owners.setdefault(owner, mark)

    def _different_outputs(self, item: Item) -> list[OutputRow]:
        """Return the outputs that only one run has; for a change, the one of a."""
        a, b = self._stretch.rows_a, self._stretch.rows_b
        mine = a.outputs(item.a) if item.a >= 0 else []
        theirs = b.outputs(item.b) if item.b >= 0 else []
        return different_outputs(mine, theirs)


def different_outputs(a: list[OutputRow], b: list[OutputRow]) -> list[OutputRow]:
    """Return the outputs that only one side has; where one changed into another of the same
    sender, that of ``a``. The order does not matter."""
    if len(a) == len(b) and all(x[:3] == y[:3] for x, y in zip(a, b, strict=True)):
        return []
    if len(a) == 1 == len(b):  # as most events: counting would take ten times as long
        return [*a] if a[0][:2] == b[0][:2] else [*a, *b]
    theirs = Counter(output[:3] for output in b)
    mine = Counter(output[:3] for output in a)
    result = list(_beyond(a, theirs))
    changed = Counter(output[:2] for output in result)
    for output in _beyond(b, mine):
        if changed[output[:2]] > 0:
            changed[output[:2]] -= 1
        else:
            result.append(output)
    return result


def _beyond(outputs: list[OutputRow], others: Counter[tuple[int, int, int]]) -> Iterator[OutputRow]:
    """Yield the outputs of which the others have fewer."""
    left = Counter(others)
    for output in outputs:
        left[output[:3]] -= 1
        if left[output[:3]] < 0:
            yield output
