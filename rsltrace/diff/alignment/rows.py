"""A block of one run as plain columns, in terms that mean the same in both runs.

Entities are numbers (see ``entity_matching``), and an event's *content* represents its outputs: the
trace's own output hash, or a new one where the ids in it differ between the runs.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import field
from functools import cached_property
from itertools import accumulate

import numpy as np

from rsltrace.diff.alignment.entity_matching import EntityMatching
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind, RandomDecision, encode_decision
from rsltrace.trace.reader import Trace

# The longest increasing subsequence: what two orders have in common at most.


def longest_increasing(values: Sequence[int]) -> frozenset[int]:
    """Return the places of as many values as can be that rise from one to the next.

    Negative values are left out. Where several choices are equally long, which one it is depends on
    the values alone. Takes n log n steps.
    """
    tails: list[int] = []  # of the best chain of each length: the value it ends with, and where
    ends: list[int] = []
    before: dict[int, int] = {}
    for place, value in enumerate(values):
        if value < 0:
            continue
        length = bisect_left(tails, value)
        if length == len(tails):
            tails.append(value)
            ends.append(place)
        tails[length], ends[length] = value, place
        before[place] = ends[length - 1] if length else -1
    chosen = set()
    place = ends[-1] if ends else -1
    while place >= 0:
        chosen.add(place)
        place = before[place]
    return frozenset(chosen)


CONSTRUCT = int(EventKind.CONSTRUCT)
BAG = int(EventKind.BAG)
TIMER = int(EventKind.TIMER)
SUBSCRIPTION = int(EventKind.SUBSCRIPTION)
ACTION = int(EventKind.ACTION)
SHUTDOWN = int(EventKind.SHUTDOWN)
_ENTITY = int(OutputKind.ENTITY)
_DRAW = int(OutputKind.DRAW)
_ZERO_DELAY = encode_decision(RandomDecision.DELAY, 0)

OutputRow = tuple[int, int, int, int]
"""(kind, number of the entity, content hash, payload sequence) of an output. The content hash of a
new entity is 0: its number says what it is, in both runs."""


@dataclass(frozen=True, slots=True)
class ComparedTrace:
    """One of the two runs. ``of_b`` says which."""

    trace: Trace
    matching: EntityMatching
    of_b: bool
    without_zero_delays: bool = False
    """Whether a delay of 0 ns counts as no delay: the jobs differ in their delays."""


OF_THEIR_OWN = (EntityKind.MAIN.label, EntityKind.THREAD.label)
"""Kinds of entities that keep a state as nodes do."""


@dataclass
class EventColumns:
    """The events ``first <= index < first + len(stamp)`` of a run, as columns.

    ``number`` is the entity, ``owner`` what a difference in this event may change for later ones:
    the node, for bag messages the topic, for a main that is of no node the main. ``at_end`` says
    that nothing follows. Constructing a node counts as an event of that node.
    """

    run: ComparedTrace
    first: int
    at_end: bool
    number: list[int]
    owner: list[int]
    kind: list[int]
    stamp: list[int]
    input: list[int]
    content: list[int]
    flags: list[int]
    state: list[int]
    cause: list[int]
    cause_output: list[int]
    output_counts: list[int] = field(repr=False)

    def __len__(self) -> int:
        return len(self.stamp)

    @property
    def end(self) -> int:
        """The index behind the last event."""
        return self.first + len(self.stamp)

    @cached_property
    def times(self) -> list[int]:
        """When each event happened, never falling: its stamp, but -1 for what is constructed
        before the run starts. The two runs may have other times for that."""
        place = 0
        if self.kind and self.kind[0] == CONSTRUCT and self._is_first:
            place = next((p for p, k in enumerate(self.kind) if k != CONSTRUCT), len(self))
        return [-1] * place + self.stamp[place:]

    @property
    def _is_first(self) -> bool:
        """Whether nothing but constructors has run before these events."""
        before = self.run.trace.events(0, self.first)
        return all(bool((part["kind"] == CONSTRUCT).all()) for part in before)

    def outputs(self, index: int) -> list[OutputRow]:
        """Return the outputs of the event with this index, in order."""
        place = index - self.first
        begin = self._output_starts[place]
        return self._output_rows[begin : begin + self.output_counts[place]]

    @cached_property
    def _output_starts(self) -> list[int]:
        return list(accumulate(self.output_counts, initial=0))

    @cached_property
    def _output_rows(self) -> list[OutputRow]:
        return output_rows(self.run, self.first, self.end)


def output_rows(run: ComparedTrace, first: int, last: int) -> list[OutputRow]:
    """Return the outputs of the events ``first <= index < last``, in order."""
    rows: list[OutputRow] = []
    for part in run.trace.outputs(first, last):
        numbers = run.matching.numbers(run.trace, part["entity"], of_b=run.of_b).tolist()
        kinds = part["kind"]
        # The recorder hashes an entity's description with the id of its node; the number says it.
        hashes = np.where(kinds == _ENTITY, np.uint64(0), part["hash"])
        columns = (kinds.tolist(), numbers, hashes.tolist(), part["sequence"].tolist())
        rows.extend(zip(*columns, strict=True))
    return rows


def load_rows(run: ComparedTrace, first: int, last: int) -> EventColumns:
    """Read the events ``first <= index < last`` (as far as there are such) of a run."""
    columns: dict[str, list[int]] = {name: [] for name in _COLUMNS}
    numbers: list[int] = []
    for part in run.trace.events(first, last):
        numbers += run.matching.numbers(run.trace, part["entity"], of_b=run.of_b).tolist()
        for name, values in columns.items():
            values += part[name].tolist()
    own = [n if key.kind in OF_THEIR_OWN else 0 for n, key in enumerate(run.matching.keys)]
    owners = [node or n for node, n in zip(run.matching.nodes, own, strict=True)]
    rows = EventColumns(
        run=run,
        first=first,
        at_end=first + len(numbers) >= run.trace.event_count,
        number=numbers,
        owner=[*map(owners.__getitem__, numbers)],
        kind=columns["kind"],
        stamp=columns["stamp"],
        input=columns["input_hash"],
        content=columns["output_hash"],
        flags=columns["flags"],
        state=columns["state_hash"],
        cause=columns["cause_event"],
        cause_output=columns["cause_output"],
        output_counts=columns["outputs"],
    )
    if CONSTRUCT in rows.kind or BAG in rows.kind:
        for place, kind in enumerate(rows.kind):
            if kind == CONSTRUCT:
                rows.number[place] = rows.owner[place] = _constructed(rows, place)
            elif kind == BAG:
                rows.owner[place] = rows.number[place]
    anew = not run.matching.same_ids or run.without_zero_delays
    if anew or run.matching.renamed:  # names are hashed where entities are made
        for place, count in enumerate(rows.output_counts):
            if anew or rows.kind[place] == CONSTRUCT:
                outputs = rows.outputs(first + place) if count else ()
                content = tuple(o[:3] for o in outputs if counts(run, o))
                rows.content[place] = hash(content) if count else 0
    return rows


_COLUMNS = (
    "kind stamp input_hash output_hash flags state_hash cause_event cause_output outputs"
).split()


def _constructed(rows: EventColumns, place: int) -> int:
    """Return the number of the first node that a constructor made (0: none)."""
    keys = rows.run.matching.keys
    for kind, number, _, _ in rows.outputs(rows.first + place):
        if kind == _ENTITY and keys[number].kind == EntityKind.NODE.label:
            return number
    return 0


def counts(run: ComparedTrace, output: OutputRow) -> bool:
    """Whether an output is compared."""
    return not (run.without_zero_delays and output[0] == _DRAW and output[2] == _ZERO_DELAY)


def outputs_of(run: ComparedTrace, index: int) -> list[OutputRow]:
    """Return the outputs of any event, in order."""
    return output_rows(run, index, index + 1)
