"""Faults: single messages lost, late or twice, what bags play changed, swapped or stale, and nodes
that crash, hang or start again."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rsltrace.errors import ExploreError, TraceError
from rsltrace.job import Job
from rsltrace.job.dump import plain_part
from rsltrace.run.plans.bags import PLAYER
from rsltrace.search.explore.strategies.strategy import Proposal, Strategy
from rsltrace.search.explore.trial import TrialResult
from rsltrace.simulation.chance.channel import QUIET_TOPICS
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.reader import Trace

if TYPE_CHECKING:
    from rsltrace.trace.decode import ValueField


_KINDS = ("change", "change", "change", "change", "swap", "repeat")
_SCALES = (-1, 0.1, 0.5, 1.1, 2, 10, 1000)
_TEXTS = ("", "x", "0", "-1", "nan", "é" * 64, "x" * 1000)
_BEYOND_INTEGERS = 1e20


@dataclass(frozen=True, slots=True)
class BagContents:
    """A topic that a bag plays: the messages that may be changed, its fields, and the lengths of
    the arrays of its first message, by name."""

    messages: range
    leaves: Sequence[ValueField]
    lengths: dict[str, int]

    def fault(self, topic: str, draw: RandomStream) -> dict[str, Any]:
        """Draw a fault of one of the messages."""
        kind = _KINDS[draw.below(len(_KINDS))]
        number = self.messages[draw.below(len(self.messages))]
        if kind == "change" and not self.leaves:
            kind = "swap"
        if kind == "repeat" and number == 1:
            kind = "swap"
        found = {kind: topic, "message": number}
        return {**found, **self._change(draw)} if kind == "change" else found

    def _change(self, draw: RandomStream) -> dict[str, Any]:
        leaf = self.leaves[draw.below(len(self.leaves))]
        name = ""
        *arrays, last = leaf.name.split("[]")
        bare = ""
        for array in arrays:
            bare += array
            name += f"{array}[{self._place(bare, draw)}]"
            bare += "[]"
        name += last
        if leaf.length_max is None:
            return {"field": name, **_another(leaf.type, draw)}
        count = self.lengths.get(leaf.name, 0)
        lengths = [0, 1, max(count - 1, 0), count + 1, 2 * count]
        return {"field": name, "length": min(lengths[draw.below(5)], leaf.length_max)}

    def _place(self, array: str, draw: RandomStream) -> str:
        """Draw which elements of an array change."""
        count = max(self.lengths.get(array, 1), 1)
        return ("*", "0", "-1", str(draw.below(count)))[draw.below(4)]


def played_in(trace: Trace, messages: dict[str, range]) -> dict[str, BagContents]:
    """Return the contents of the bags played in a run, for topics with messages that may be
    changed."""
    found = {}
    for name in sorted({one.name for one in trace.entities.values() if is_played(trace, one)}):
        if name in messages:
            leaves: list[ValueField] = []
            lengths: dict[str, int] = {}
            with suppress(TraceError):  # without payloads, messages can still be swapped
                leaves = trace.leaves(name)
                first = next(trace.messages(name), None)
                if first is not None:
                    lengths.update(_lengths(trace.decode(name, first[-1]), leaves))
            there = [leaf for leaf in leaves if _is_there(leaf, lengths)]
            found[name] = BagContents(messages[name], there, lengths)
    return found


def is_played(trace: Trace, entity: Entity) -> bool:
    """Whether an entity of a run publishes what a bag plays."""
    is_publisher = entity.kind is EntityKind.PUBLISHER
    return is_publisher and trace.node_of(entity).name == f"/{PLAYER}"


def _lengths(message: Any, leaves: Sequence[ValueField]) -> Iterator[tuple[str, int]]:
    """Yield the lengths of a message's arrays; of nested ones, the first."""
    for leaf in leaves:
        value, name = message, ""
        if leaf.length_max is None:
            continue
        for part in leaf.name.split("."):
            field = part.removesuffix("[]")
            value = getattr(value, field, ())
            name = f"{name}.{field}" if name else field
            if field != part:
                if not len(value):
                    break
                value, name = value[0], f"{name}[]"
        else:
            yield name, len(value)


def _is_there(leaf: ValueField, lengths: dict[str, int]) -> bool:
    """Whether none of the arrays that a field is in is empty."""
    arrays = leaf.name.split("[]")[:-1]
    return all(lengths.get("[]".join(arrays[: n + 1]), 1) for n in range(len(arrays)))


def _another(kind: str, draw: RandomStream) -> dict[str, Any]:
    """Draw a different value for a field of a type."""
    if kind == "string":
        return {"value": _TEXTS[draw.below(len(_TEXTS))]}
    if kind == "bool":
        return {"value": bool(draw.below(2))}
    is_float = kind.startswith("float")
    what = draw.below(3)
    if what == 0:
        return {"scale": _SCALES[draw.below(len(_SCALES))]}
    sign = 1 if draw.below(2) else -1
    if what == 1:
        return {"offset": sign * 10 ** draw.below(5) / (100 if is_float else 1)}
    if is_float:
        values = ("nan", "inf", "-inf", 0, 3e38 * sign)
        return {"value": values[draw.below(len(values))]}
    # Values beyond the type's limits are clipped to them.
    return {"offset": _BEYOND_INTEGERS * sign} if draw.below(2) else {"value": 0}


_MOST = 3
_SHORTEST_NS = 1_000_000
_OF_MESSAGES = ("drop", "delay", "duplicate")


class FaultWalk(Strategy):
    """Up to three random faults per run, besides those of the job. Order and seed are the job's."""

    def __init__(self, job: Job, seed: int = 0, *, fork_ns: int = -1) -> None:
        """``fork_ns``: the simulated time up to which there are no faults."""
        self._own = [plain_part(fault) for fault in job.faults]
        self._seed = seed
        self._fork_ns = fork_ns
        self._topics: dict[str, range] = {}
        """By topic, the messages that may have a fault."""
        self._played: dict[str, BagContents] = {}
        """By topic that a bag plays, its contents."""
        self._progress = job.progress
        self._nodes: dict[str, bool] = {}
        self._events = range(1)
        self._longest_ns = 1
        self._kinds: Counter[str] = Counter()
        self._tried = 0

    def begin(self, plain: TrialResult) -> None:
        """Find the nodes and messages of the plain run."""
        if plain.trace is None:
            raise ExploreError("the plain run has no trace, so there is nothing to apply faults to")
        with Trace.open(plain.trace) as trace:
            self._longest_ns = max(trace.end_ns - trace.start_ns, 2 * _SHORTEST_NS)
            first, first_output = _first_after(trace, self._fork_ns)
            self._events = range(first, max(trace.ended_after or trace.event_count, 1))
            before, after = _sent(trace, first_output)
            names: dict[str, tuple[int, int]] = {}
            played: dict[str, tuple[int, int]] = {}
            for entity in trace.entities.values():
                if entity.kind is EntityKind.NODE and entity.name != f"/{PLAYER}":
                    self._nodes[entity.name] = bool(entity.type)  # others have a real process
                elif before[entity.id] + after[entity.id] and entity.name not in QUIET_TOPICS:
                    one, two = names.get(entity.name, (0, 0))
                    names[entity.name] = one + before[entity.id], two + after[entity.id]
                    if is_played(trace, entity) and entity.name != self._progress:
                        one, two = played.get(entity.name, (0, 0))
                        played[entity.name] = one + before[entity.id], two + after[entity.id]
            self._played = played_in(trace, _to_come(played))
        self._topics = _to_come(names)
        if not self._events:
            raise ExploreError("the plain run ends before the time of --fork-after")
        if not self._nodes and not self._topics:
            raise ExploreError(
                "the plain run has neither nodes nor messages that could have a fault"
            )

    def propose(self, number: int) -> Proposal | None:
        draw = RandomStream(self._seed, f"faults\0{number}")
        faults = [self._fault(draw) for _ in range(1 + draw.below(_MOST))]
        self._count(faults)
        why = "; ".join(", ".join(f"{k} {v}" for k, v in fault.items()) for fault in faults)
        return Proposal({"faults": [*self._own, *faults]}, why)

    def recall(self, result: TrialResult) -> None:
        self._count(result.trial.overlay.get("faults", [])[len(self._own) :])

    def coverage(self) -> list[str]:
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(self._kinds.items()))
        return [
            f"faults: {self._tried} runs with up to {_MOST} each ({kinds}), among "
            f"{sum(map(len, self._topics.values()))} messages of {len(self._topics)} topics and "
            f"{len(self._nodes)} nodes"
        ]

    def _count(self, faults: list[dict[str, Any]]) -> None:
        self._tried += 1
        self._kinds.update(next(iter(fault)) for fault in faults)

    def _fault(self, draw: RandomStream) -> dict[str, Any]:
        if self._topics and (not self._nodes or draw.below(2)):
            topic = list(self._topics)[draw.below(len(self._topics))]
            if topic in self._played and draw.below(3):
                return self._played[topic].fault(topic, draw)
            kind = _OF_MESSAGES[draw.below(len(_OF_MESSAGES))]
            messages = self._topics[topic]
            fault = {kind: topic, "message": messages[draw.below(len(messages))]}
            return fault if kind == "drop" else {**fault, "by": self._time(draw)}
        node = list(self._nodes)[draw.below(len(self._nodes))]
        kinds = ("crash", "restart", "hang") if self._nodes[node] else ("crash", "restart")
        kind = kinds[draw.below(len(kinds))]
        fault = {kind: node, "event": self._events[draw.below(len(self._events))]}
        return fault if kind == "crash" else {**fault, "for": self._time(draw)}

    def _time(self, draw: RandomStream) -> str:
        """Draw a duration, log-uniform, in whole milliseconds."""
        ratio = self._longest_ns / _SHORTEST_NS
        return f"{max(round(math.exp(draw.uniform() * math.log(ratio))), 1)}ms"


def _to_come(counts: dict[str, tuple[int, int]]) -> dict[str, range]:
    """Return the numbers of each topic's later messages; no topics without any."""
    return {name: range(1 + one, 1 + one + two) for name, (one, two) in counts.items() if two}


def _first_after(trace: Trace, fork_ns: int) -> tuple[int, int]:
    """Return the first event after a time since the start of the run, and the number of outputs
    before it."""
    if fork_ns < 0:
        return 0, 0
    events = outputs = 0
    for rows in trace.events():
        stamps = rows["stamp"]
        count = int(np.searchsorted(stamps, trace.start_ns + fork_ns, side="right"))
        events += count
        outputs += int(rows["outputs"][:count].sum())
        if count < len(stamps):
            break
    return events, outputs


def _sent(trace: Trace, first_output: int) -> tuple[Counter[int], Counter[int]]:
    """Return how many messages each publisher sent among the first outputs, and after them."""
    sent: tuple[Counter[int], Counter[int]] = Counter(), Counter()
    seen = 0
    for rows in trace.outputs():
        place = min(max(first_output - seen, 0), len(rows))
        for counter, some in zip(sent, (rows[:place], rows[place:]), strict=True):
            wanted = some["entity"][some["kind"] == OutputKind.MESSAGE]
            numbers, counts = np.unique(wanted, return_counts=True)
            counter.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
        seen += len(rows)
    return sent
