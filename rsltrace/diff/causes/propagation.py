"""What follows from what: which of the differing events are consequences of an earlier one.

An event that differs is a consequence if what caused it differs (the message it received, the
event that made it) or if its node did something different before, since nobody sees into the state
of a node. What is neither is a divergence of its own. Every consequence remembers what it follows
from, so that the way back to the root can be shown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, replace
from functools import cached_property

from rsltrace.diff.alignment.blocks import AlignedBlock, EventPair, mark_inverted
from rsltrace.diff.alignment.outputs import beyond, different_outputs, places_beyond
from rsltrace.diff.alignment.rows import (
    ACTION,
    BAG,
    CONSTRUCT,
    OF_THEIR_OWN,
    SHUTDOWN,
    SUBSCRIPTION,
    EventColumns,
    OutputRow,
    counts,
)
from rsltrace.diff.causes.relevance import resolved_job
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind
from rsltrace.trace.reader import Trace

CAUSE = "cause"
NODE = "node"
DRAWN = "drawn"
MADE = "made"
BUSY = "busy"
STUCK = "stuck"
REACHING = frozenset((OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE))

UNDECIDED = -1
_DRAW = int(OutputKind.DRAW)
_ENTITY = int(OutputKind.ENTITY)
_RESUME = int(EventKind.RESUME)

_REMEMBERED_MAX = 50_000
_DEPTH_MAX = 100
"""Steps of a way back that are kept."""


@dataclass(slots=True)
class DivergenceOrigin:
    """Why an event differs. ``root`` is the number of the divergence it follows from (or is), or
    UNDECIDED until the end of the instant.

    ``why`` is ``cause`` or ``node``, and ``previous`` the origin of the event it follows from that
    way; None for a root. ``depth`` counts the steps back to it.
    """

    item: EventPair
    root: int
    why: str | None
    previous: DivergenceOrigin | None
    depth: int = 0


@dataclass(slots=True)
class FoundDivergence:
    """A divergence before it is put in words.

    ``place_a`` and ``place_b`` say where it stands in runs that have no such event. ``reached``
    holds for each publisher, client or service: first stamp, number of messages, and how much later
    (in b) the first one was sent, if it only moved (else 0). ``cause_only`` is
    set where nothing but the cause differs. ``swapped`` are the entities that changed places.
    """

    origin: DivergenceOrigin
    stamp: int
    place_a: int
    place_b: int
    reached: dict[int, tuple[int, int, int]] = field(default_factory=dict)
    cause_only: bool = False
    swapped: frozenset[int] = frozenset()


class Propagation:
    """Takes blocks in order and sorts differing events into roots and consequences.

    ``found`` are the roots, in order. ``watched`` is the first consequence for which ``watch``
    (a function of item and block) is true.
    """

    def __init__(self, watch: Callable[[EventPair, AlignedBlock], bool] | None = None) -> None:
        self.found: list[FoundDivergence] = []
        self.watched: FoundDivergence | None = None
        self._watch = watch
        self._owners: dict[int, DivergenceOrigin] = {}
        self._origins_a: dict[int, DivergenceOrigin] = {}
        self._origins_b: dict[int, DivergenceOrigin] = {}
        self._block: AlignedBlock
        self._moment: list[DivergenceOrigin] = []
        self._moment_stamp = -1
        self._inverted_in: dict[int, int] = {}
        self._sent: dict[str, DivergenceOrigin] = {}
        self._drawn: DivergenceOrigin | None = None
        self._made: dict[int, DivergenceOrigin] = {}
        self._busy: DivergenceOrigin | None = None
        self._different: dict[tuple[int, int], list[OutputRow]] = {}
        """In which outputs an item of this block differs."""
        self._passed_on: dict[tuple[int, bool], tuple[set[int], set[int]]] = {}
        """By a cause in this block and its run, since one can have thousands of consequences: for
        what it drew other numbers, and which of its outputs the other run does not have."""

    def origin_of(self, item: EventPair) -> DivergenceOrigin | None:
        """Return why an item differs, if it does."""
        return self._origins_a.get(item.a) or self._origins_b.get(item.b)

    def found_at(self, item: EventPair, origin: DivergenceOrigin) -> FoundDivergence:
        """Return an item of the last block as what to put in words."""
        reached = self.found[origin.root].reached
        places = self._places(item)
        if item.inverted:  # where the order changes
            moment = [i for i in self._block.items if i.inverted and self._is_with(i, item)]
            places = min(i.a for i in moment), min(i.b for i in moment)
        return FoundDivergence(origin, self._first_stamp(item), *places, reached)

    def _is_with(self, one: EventPair, other: EventPair) -> bool:
        return self._block.stamp(one) == self._block.stamp(other)

    def take(self, block: AlignedBlock, first: EventPair | None = None) -> None:
        """Go through a block. ``first``, if given, is the divergence the search has found: it
        is a root whatever else there is, and comes before everything."""
        self._block = block
        self._different.clear()
        self._passed_on.clear()
        if first is not None:
            self._seed(first)
        for item in block.items:
            if not item.plain and not item.beyond and self.origin_of(item) is None:
                self._take_item(item)
        self._end_moment()
        self._forget(block)

    def _seed(self, first: EventPair) -> None:
        found = self._root(first)
        if first.a < 0 or first.b < 0:  # until here the indexes of both runs are the same
            found.place_a = found.place_b = max(first.a, first.b)
        found.cause_only = first.plain
        if first.plain:
            return
        self._moment_stamp = found.stamp
        self._spread(first, found.origin)
        if first.inverted:
            # All that changed places at this instant is one divergence, and so is what follows.
            found.place_a = found.place_b = min(first.a, first.b)
            swapped = [
                item
                for item in self._block.items
                if item.inverted and self._block.stamp(item) == found.stamp
            ]
            found.swapped = self._entities(swapped)
            for item in swapped:
                if item is not first:
                    why, previous = self._explanation(item)
                    self._consequence(item, why, previous or found.origin)

    # -- one event -----------------------------------------------------------------------------

    def _take_item(self, item: EventPair) -> None:
        rows, place = self._rows(item)
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
            origin = DivergenceOrigin(item, UNDECIDED, why, previous)
            self._moment.append(origin)
            self._remember(item, origin)
        else:
            self._take_alone(item)

    def _take_alone(self, item: EventPair) -> None:
        """Take an item that differs and follows from nothing by its cause or its node."""
        rows, place = self._rows(item)
        previous: DivergenceOrigin | None = None
        if self._busy is None and self._moved_by(item):
            self._take_others_at(self._first_stamp(item))
            why, previous = self._explanation(item)
        if previous is not None:
            self._consequence(item, why, previous)
        elif (shared := self._shared_root(item)) is not None:
            self._consequence(item, *shared)
        elif rows.kind[place] != SHUTDOWN and not self._is_unwinding(item):
            self._spread(item, self._root(item).origin)  # when the run ends is said elsewhere

    def _take_others_at(self, stamp: int) -> None:
        """Take what only one run has at a time: it may have kept others waiting."""
        for item in self._block.items:
            alone = (item.a < 0 or item.b < 0) and not item.beyond
            if alone and self._block.stamp(item) == stamp and self.origin_of(item) is None:
                self._take_item(item)

    def _shared_root(self, item: EventPair) -> tuple[str, DivergenceOrigin] | None:
        """Return what an item follows from that neither its cause nor its node tells: what is drawn
        differently once is drawn differently again, and who is busy for longer keeps others
        waiting."""
        a, b = self._block.rows_a, self._block.rows_b
        if item.a < 0 or item.b < 0:
            rows, place = self._rows(item)
            stuck = (b if item.b < 0 else a).run.trace
            if _failed(stuck) and not _failed(rows.run.trace) and self.found:
                return STUCK, self.found[0].origin
            if rows.kind[place] not in (SUBSCRIPTION, ACTION):
                return None
            if self._busy is not None:
                return BUSY, self._busy
            # A message that both sent: what else was sent on its topic took its place in the queue.
            topic = rows.run.matching.keys[rows.number[place]].name
            return (CAUSE, self._sent[topic]) if topic in self._sent else None
        i, j = item.a - a.first, item.b - b.first
        if a.stamp[i] != b.stamp[j]:
            waits = self._busy is not None and a.kind[i] != BAG
            return (BUSY, self._busy) if self._busy is not None and waits else None
        only_drawn = a.input[i] == b.input[j] and a.flags[i] == b.flags[j]
        if not only_drawn or a.state[i] != b.state[j]:
            return None
        outputs = self._different_outputs(item)
        if not outputs or any(output[0] != _DRAW for output in outputs):
            return None
        if all(output[1] in self._made for output in outputs):
            return MADE, self._made[outputs[0][1]]
        return (DRAWN, self._drawn) if self._drawn is not None else None

    def _is_unwinding(self, item: EventPair) -> bool:
        """Whether an item is what a run did when it had ended."""
        a, b = self._block.rows_a.run.trace, self._block.rows_b.run.trace
        return any(
            index >= 0 and trace.ended_after is not None and index >= trace.ended_after
            for trace, index in ((a, item.a), (b, item.b))
        )

    def _consequence(self, item: EventPair, why: str | None, previous: DivergenceOrigin) -> None:
        depth = previous.depth + 1
        if depth > _DEPTH_MAX:  # forgets what is further back
            why, previous, depth = None, self.found[previous.root].origin, 1
        origin = DivergenceOrigin(item, previous.root, why, previous, depth)
        self._remember(item, origin)
        self._spread(item, origin)
        if self._watch is not None and self.watched is None and self._watch(item, self._block):
            self.watched = FoundDivergence(origin, self._block.stamp(item), *self._places(item))

    def _rows(self, item: EventPair) -> tuple[EventColumns, int]:
        """Return the run that has an item, a if both have, and its place in the columns."""
        if item.a >= 0:
            rows = self._block.rows_a
            return rows, item.a - rows.first
        rows = self._block.rows_b
        return rows, item.b - rows.first

    def _entities(self, items: list[EventPair]) -> frozenset[int]:
        rows = self._block.rows_a
        return frozenset(rows.number[item.a - rows.first] for item in items)

    def _root(self, item: EventPair) -> FoundDivergence:
        origin = DivergenceOrigin(item, len(self.found), None, None)
        place_a, place_b = self._places(item)
        found = FoundDivergence(origin, self._first_stamp(item), place_a, place_b)
        self.found.append(found)
        self._remember(item, origin)
        return found

    def _places(self, item: EventPair) -> tuple[int, int]:
        """Return the indexes of an item; where it is missing, of what follows it there."""
        block = self._block
        if item.a >= 0 and item.b >= 0:
            return item.a, item.b
        position = next(i for i, other in enumerate(block.items) if other is item)
        for other in block.items[position + 1 :]:
            if item.a < 0 and other.a >= 0:
                return other.a, item.b
            if item.b < 0 and other.b >= 0:
                return item.a, other.b
        return (block.end_a, item.b) if item.a < 0 else (item.a, block.end_b)

    def _remember(self, item: EventPair, origin: DivergenceOrigin) -> None:
        if item.a >= 0:
            self._origins_a[item.a] = origin
        if item.b >= 0:
            self._origins_b[item.b] = origin

    def _forget(self, block: AlignedBlock) -> None:
        """Drop what lies before this block: a run that never agrees again has millions."""
        if len(self._origins_a) + len(self._origins_b) > _REMEMBERED_MAX:
            first_a, first_b = block.rows_a.first, block.rows_b.first
            self._origins_a = {i: origin for i, origin in self._origins_a.items() if i >= first_a}
            self._origins_b = {i: origin for i, origin in self._origins_b.items() if i >= first_b}

    def _end_moment(self) -> None:
        """Decide on what only changed places at the last instant, now that all of it is known."""
        moment, self._moment = self._moment, []
        self._inverted_in.clear()
        if not moment:
            return
        # Those that only changed places with a consequence were passed by it and did nothing.
        copies = [EventPair(origin.item.a, origin.item.b, True) for origin in moment]
        mark_inverted(copies)
        still = {copy.a: copy.b for copy in copies if copy.inverted}
        swapped = self._entities([origin.item for origin in moment if origin.item.a in still])
        # A tie that is broken differently once is so every time: that is one divergence.
        root = next((found for found in self.found if swapped and swapped <= found.swapped), None)
        for origin in moment:
            item = origin.item
            self._origins_a.pop(item.a, None)
            self._origins_b.pop(item.b, None)
            if item.a not in still:
                continue
            if root is None:
                root = self._root(item)
                root.place_a, root.place_b = min(still), min(still.values())
                root.swapped = swapped
                self._spread(item, root.origin)
            else:
                known = origin.previous and self.origin_of(origin.previous.item)
                self._consequence(item, origin.why if known else None, known or root.origin)

    # -- why -------------------------------------------------------------------------------------

    def _explanation(self, item: EventPair) -> tuple[str | None, DivergenceOrigin | None]:
        """Return what an item follows from: ``cause`` or ``node``, and the origin of that."""
        a, b = self._block.rows_a, self._block.rows_b
        i, j = item.a - a.first, item.b - b.first
        caused = True
        if item.a >= 0 and item.b >= 0 and not item.inverted:
            caused = a.input[i] != b.input[j] or a.stamp[i] != b.stamp[j]
        if caused:
            if item.a >= 0:
                origin = self._origins_a.get(a.cause[i])  # never NO_EVENT
                if origin is not None and self._passes_on(origin, a, i, item):
                    return CAUSE, origin
            if item.b >= 0:
                origin = self._origins_b.get(b.cause[j])
                if origin is not None and self._passes_on(origin, b, j, item):
                    return CAUSE, origin
        by_node = self._owners.get(self._acting(a, i) if item.a >= 0 else self._acting(b, j))
        return (NODE, by_node) if by_node is not None else (None, None)

    def _acting(self, rows: EventColumns, place: int) -> int:
        """Return whose doing an event is: of a constructor, the node that it starts again (0: it
        starts it for the first time)."""
        if rows.kind[place] != CONSTRUCT:
            return rows.owner[place]
        matching = rows.run.matching
        key = matching.keys[rows.number[place]]
        return matching.by_key.get(replace(key, ordinal=key.ordinal - 1), 0)

    def _passes_on(
        self, origin: DivergenceOrigin, rows: EventColumns, place: int, item: EventPair
    ) -> bool:
        """Whether the difference of a cause is one that the event it caused can have got.

        A message that is the same may still have had another delay.
        """
        cause = origin.item
        if cause.a < 0 or cause.b < 0:
            return True
        a, b = self._block.rows_a, self._block.rows_b
        i, j = cause.a - a.first, cause.b - b.first
        if not 0 <= i < len(a.stamp) or not 0 <= j < len(b.stamp):
            return True  # of an earlier block: not looked at again
        if a.stamp[i] != b.stamp[j] or (item.inverted and cause.inverted):
            return True
        mine = i if rows is a else j
        nth = rows.cause_output[place]
        if nth >= rows.output_counts[mine]:
            return True
        known = self._passed_on.get((mine, rows is a))
        if known is None:
            drawn = {o[1] for o in self._different_outputs(cause) if o[0] == _DRAW}
            outputs, others = a.outputs(cause.a), b.outputs(cause.b)
            alone = places_beyond(*((outputs, others) if rows is a else (others, outputs)))
            known = self._passed_on[mine, rows is a] = drawn, {*alone}
        drawn, alone_places = known
        # A delay is drawn for the receiver, an execution time for what ran.
        if drawn and (rows.number[place] in drawn or rows.number[mine] in drawn):
            return True
        return nth in alone_places

    # -- what follows ----------------------------------------------------------------------------

    def _spread(self, item: EventPair, origin: DivergenceOrigin) -> None:
        """Note what a differing event affects: its node, and the topics of what it sent."""
        rows, place = self._rows(item)
        owner, matching = rows.owner[place], rows.run.matching
        if item.same:
            # Only reordered: its node notices only if it received two inputs in a different order.
            self._inverted_in[owner] = self._inverted_in.get(owner, 0) + 1
            if self._inverted_in[owner] >= 2:
                self._taint(owner, origin)
            return
        outputs = self._different_outputs(item)
        nodes, keys = matching.nodes, matching.keys
        moved_ns = self._moved_by(item)
        stamp = rows.stamp[place] + min(moved_ns, 0)
        reached = self.found[origin.root].reached
        changes_owner = not outputs or item.a < 0 or item.b < 0
        takes_longer = self._workers_are_shared and self._waits_otherwise(item)
        for kind, number, _, _ in outputs:
            if kind == _DRAW:
                # A draw for a link does not change the sender; one for its clock does.
                changes_owner = changes_owner or nodes[number] == number
                takes_longer = takes_longer or number == rows.number[place]
                self._drawn = self._drawn or origin
                continue
            changes_owner = True
            if kind == _ENTITY:  # the node may be one that only this run has
                self._made.setdefault(number, origin)
                self._taint(nodes[number], origin)
            elif kind in REACHING:
                _reach(reached, number, stamp, 0)
                self._sent.setdefault(keys[number].name, origin)
                if rows.kind[place] == CONSTRUCT:  # of one of several nodes that a main makes
                    self._taint(nodes[number], origin)
        if changes_owner:
            self._taint(owner, origin)
        if takes_longer:
            self._busy = self._busy or origin
        if rows.kind[place] == CONSTRUCT:  # a program and the nodes that it makes are one
            for kind, number, _, _ in rows.outputs(rows.first + place):
                if kind == _ENTITY and (
                    nodes[number] == number or keys[number].kind in OF_THEIR_OWN
                ):
                    self._taint(number, origin)
        if moved_ns:  # what both runs have was sent at another time
            for kind, number, _, _ in beyond(rows.outputs(rows.first + place), outputs):
                if kind in REACHING:
                    _reach(reached, number, stamp, moved_ns)

    @cached_property
    def _workers_are_shared(self) -> bool:
        """Whether a callback that waits keeps those of other nodes waiting."""
        runs = self._block.rows_a.run, self._block.rows_b.run
        return any(resolved_job(run.trace).get("executors") for run in runs)

    def _waits_otherwise(self, item: EventPair) -> bool:
        """Whether a callback waits in one run only, or for another time."""
        waits = []
        for rows, index in ((self._block.rows_a, item.a), (self._block.rows_b, item.b)):
            if index >= 0:
                place = index - rows.first
                if rows.kind[place] == _RESUME and (self._moved_by(item) or -1 in (item.a, item.b)):
                    return True
                waits.append(bool(rows.flags[place] & EventFlag.SUSPENDED))
        return any(waits) and not (len(waits) == 2 and all(waits))

    def _moved_by(self, item: EventPair) -> int:
        a, b = self._block.rows_a, self._block.rows_b
        if item.a < 0 or item.b < 0:
            return 0
        return b.stamp[item.b - b.first] - a.stamp[item.a - a.first]

    def _first_stamp(self, item: EventPair) -> int:
        """Return when an item happened in whichever run had it first."""
        return self._block.stamp(item) + min(self._moved_by(item), 0)

    def _taint(self, owner: int, origin: DivergenceOrigin) -> None:
        if owner:
            self._owners.setdefault(owner, origin)

    def _different_outputs(self, item: EventPair) -> list[OutputRow]:
        """Return ``outputs_of_one``; of a cause it was asked for before."""
        known = self._different.get((item.a, item.b))
        if known is None:
            known = self._different[item.a, item.b] = outputs_of_one(self._block, item)
        return known


def _reach(
    reached: dict[int, tuple[int, int, int]], number: int, stamp: int, moved_ns: int
) -> None:
    first, count, moved = reached.get(number, (stamp, 0, moved_ns))
    # Of two at one time it is the one that did not only move, whichever run is called a.
    if stamp < first or (stamp == first and abs(moved_ns) < abs(moved)):
        first, moved = stamp, moved_ns
    reached[number] = (first, count + 1, moved)


def _failed(trace: Trace) -> bool:
    return trace.complete and trace.result.get("exit_code", "0") != "0"


def outputs_of_one(block: AlignedBlock, item: EventPair) -> list[OutputRow]:
    """Return the outputs of an item that only one run has; for a change, the one of a."""
    a, b = block.rows_a, block.rows_b
    mine = a.outputs(item.a) if item.a >= 0 else []
    theirs = b.outputs(item.b) if item.b >= 0 else []
    if a.run.without_zero_delays:
        mine = [output for output in mine if counts(a.run, output)]
        theirs = [output for output in theirs if counts(b.run, output)]
    return different_outputs(mine, theirs)
