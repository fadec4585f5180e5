"""What came through a chain, and how long it took: docs/latency.md has the definitions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rsltrace.checks.latency.flow import MessageFlow
from rsltrace.checks.latency.paths import NO_PATH
from rsltrace.trace.model.entity import EntityKind

# A series of durations in a few numbers.

Durations = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class LatencyFigures:
    """Durations in ns: how many, the least, quantiles, the most, their mean and deviation.

    A quantile is one of the durations, the smallest that so many do not exceed.
    """

    count: int
    min_ns: int
    p50_ns: int
    p95_ns: int
    p99_ns: int
    max_ns: int
    mean_ns: float
    sd_ns: float

    @property
    def jitter_ns(self) -> int:
        """The most less the least."""
        return self.max_ns - self.min_ns


def figures(durations: Durations) -> LatencyFigures | None:
    """Return the figures of durations, None if there are none."""
    if not len(durations):
        return None
    ordered = np.sort(durations)
    return LatencyFigures(
        len(ordered),
        int(ordered[0]),
        quantile(ordered, 50),
        quantile(ordered, 95),
        quantile(ordered, 99),
        int(ordered[-1]),
        float(ordered.mean()),
        float(ordered.std()),
    )


def quantile(ordered: Durations, percent: float) -> int:
    """Return the smallest of some sorted durations that ``percent`` of them do not exceed."""
    rank = math.ceil(round(percent * len(ordered) / 100, 9))
    return int(ordered[min(max(rank, 1), len(ordered)) - 1])


Integers = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ChainMessages:
    """The inputs and outputs of a chain, each in the order in which they left.

    ``came`` has a row for each output and a column for each hop: the rows of its messages in
    ``MessageFlow.messages``, shape (outputs, hops). ``source`` is the place of its input among
    the inputs. Times are in ns.
    """

    input_rows: Integers
    input_ns: Integers
    came: Integers
    output_ns: Integers
    source: Integers

    @property
    def first(self) -> Integers:
        """The places of the outputs that are the first of their input."""
        places: Integers = np.sort(np.unique(self.source, return_index=True)[1]).astype(np.int64)
        return places

    def ages_ns(self) -> Integers:
        """Return how old the input of each output is when that leaves."""
        return self.output_ns - self.input_ns[self.source]

    def last_ages_ns(self) -> Integers:
        """Return how old the input of each output but the last is when the next one leaves."""
        return self.output_ns[1:] - self.input_ns[self.source[:-1]]

    def answers(self) -> Integers:
        """Return for each input the place of the first output that comes of it, or of a later one.

        Inputs that nothing answers are at the end, and are missing.
        """
        newest = np.maximum.accumulate(self.source) if len(self.source) else self.source
        places = np.searchsorted(newest, np.arange(len(self.input_ns)))
        found: Integers = places[places < len(newest)].astype(np.int64)
        return found

    def reactions_ns(self) -> Integers:
        """Return how long each input that is answered waits for that."""
        answers = self.answers()
        return self.output_ns[answers] - self.input_ns[: len(answers)]

    def worst_reactions_ns(self) -> Integers:
        """Return the same of what happens right after the input before: shape (answered - 1,)."""
        answers = self.answers()[1:]
        return self.output_ns[answers] - self.input_ns[: len(answers)]


def instances(flow: MessageFlow, path: int) -> ChainMessages:
    """Return what came through a path."""
    messages = flow.messages
    paths, parents, published = (messages.column(one) for one in ("path", "parent", "published"))
    last = np.flatnonzero(paths == path)
    last = last[np.argsort(published[last], kind="stable")]
    came = [last]
    for _ in flow.paths.hops[path][1:]:
        came.insert(0, parents[came[0]])
    inputs = _rows(flow, paths, path, 1, came[0])
    inputs = inputs[np.argsort(published[inputs], kind="stable")]
    places = np.zeros(messages.count, dtype=np.int64)
    places[inputs] = np.arange(len(inputs))
    return ChainMessages(
        inputs, published[inputs], np.stack(came, axis=1), published[last], places[came[0]]
    )


def _rows(flow: MessageFlow, paths: Integers, path: int, length: int, used: Integers) -> Integers:
    """Return the messages that have come through the first hops of a path. In a loop, which has no
    beginning, those are known that were ``used``."""
    begun = flow.paths.prefix(path, length)
    came = np.flatnonzero(paths == begun) if begun != NO_PATH else used[:0]
    return np.union1d(came, used)


@dataclass(frozen=True, slots=True)
class HopTimes:
    """Where the time of a hop goes, in ns, shape (outputs,) each: from one message leaving to the
    next one leaving these add up.

    ``link``: on its way; ``queue``: until a callback takes it; ``held``: from there until the
    callback begins (or goes on) that publishes; ``runs``: from there until what it sends leaves.
    """

    link: Integers
    queue: Integers
    held: Integers
    runs: Integers


def parts_of(flow: MessageFlow, found: ChainMessages) -> list[HopTimes]:
    """Return where the time goes, for each hop after the first."""
    messages, taken = flow.messages, flow.taken
    published, began, received = (messages.column(n) for n in ("published", "began", "taken"))
    starts, delays = taken.column("began"), taken.column("delay")
    parts = []
    for before, after in zip(found.came.T[:-1], found.came.T[1:], strict=True):
        sent, start = published[before], starts[received[after]]
        arrived = np.minimum(sent + np.maximum(delays[received[after]], 0), start)
        parts.append(
            HopTimes(
                arrived - sent,
                start - arrived,
                began[after] - start,
                published[after] - began[after],
            )
        )
    return parts


@dataclass(frozen=True, slots=True)
class HopMessages:
    """How many messages of a hop went on to the next one.

    ``sent`` leave while the next node has a subscription; of these ``received`` are taken by a
    callback, ``lost`` on their way, ``overwritten`` dropped from a queue (or too old) before one
    took them, and ``waiting`` when the run ended. ``used`` are behind an output of the chain.
    """

    sent: int
    received: int
    lost: int
    overwritten: int
    waiting: int
    used: int


def passages(flow: MessageFlow, path: int, found: ChainMessages) -> list[HopMessages]:
    """Return what became of the messages of each hop but the last, on the way to the next one."""
    messages, taken = flow.messages, flow.taken
    keys, paths, published = (messages.column(one) for one in ("key", "path", "published"))
    hops = flow.paths.named(path)
    passed = []
    for place in range(len(hops) - 1):
        node = hops[place + 1].node
        rows = _rows(flow, paths, path, place + 1, found.came[:, place])
        firsts = np.unique(np.searchsorted(keys, keys[rows]))
        got = _to_node(flow, taken.column("message"), taken.column("entity"), node)
        lost = _to_node(flow, flow.lost.column("message"), flow.lost.column("entity"), node)
        received = np.isin(firsts, got)
        there = received | (published[firsts] >= _created_ns(flow, node, hops[place].topic))
        gone = there & ~received & np.isin(firsts, lost)
        rest = np.flatnonzero(there & ~received & ~gone)
        last = np.flatnonzero(received)[-1] if received.any() else -1
        passed.append(
            HopMessages(
                int(there.sum()),
                int(received.sum()),
                int(gone.sum()),
                int((rest < last).sum()),
                int((rest > last).sum()),
                len(np.unique(keys[found.came[:, place]])),
            )
        )
    return passed


def _to_node(flow: MessageFlow, rows: Integers, entities: Integers, node: str) -> Integers:
    ids = [one for one in np.unique(entities).tolist() if flow.node_of(one) == node]
    return rows[np.isin(entities, ids)]


def _created_ns(flow: MessageFlow, node: str, topic: str) -> int:
    """Return when a node has made its first subscription of a topic."""
    return min(
        (
            one.created_ns
            for one in flow.trace.entities.values()
            if one.name == topic
            and one.kind is EntityKind.SUBSCRIPTION
            and flow.node_of(one.id) == node
        ),
        default=0,
    )
