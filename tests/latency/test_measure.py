"""Latencies of chains against their definitions, on random graphs and on a run of real nodes."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rsltrace.checks.evaluate import check_latency
from rsltrace.checks.latency.instances import HopTimes, figures
from rsltrace.checks.latency.measure import MEASURES, ChainLatency, measure_latencies
from rsltrace.checks.latency.paths import Hop
from rsltrace.errors import TraceError
from rsltrace.job.parts.check import LatencySpec
from rsltrace.trace.dtypes import EVENT_DTYPE, OUTPUT_DTYPE
from rsltrace.trace.format import CDR_HEADER, METADATA_NATIVE, TIMING, TOPIC_TIMINGS
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import (
    NO_EVENT,
    EventFlag,
    EventKind,
    OutputKind,
    RandomDecision,
    encode_decision,
)
from rsltrace.trace.model.texts import Stamp
from tests.tiers import cases

NODES, TOPICS = 3, 4
RUNS = cases(15, 100)


@dataclass
class Sent:
    """A message: where in the trace, and what it came of by the definition."""

    hop: Hop
    cause: tuple[int, int]
    left_ns: int
    began_ns: int
    came: Sent | None = None
    start_ns: int = 0
    """When the callback began that took ``came``."""
    delays: dict[int, int] = field(default_factory=dict)
    last: dict[str, tuple[Sent, int]] = field(default_factory=dict)
    """By topic, what its node had received last when it was published, and when that began."""

    def hops(self) -> list[Sent]:
        return [*(self.came.hops() if self.came else ()), self]


@dataclass
class MadeRun:
    """What of a trace is looked at: entities, and segments of events and outputs."""

    name: str = "made.mcap"
    entities: dict[int, Entity] = field(default_factory=dict)
    rows: list[tuple[Any, ...]] = field(default_factory=list)
    sent: list[tuple[Any, ...]] = field(default_factory=list)
    cuts: list[int] = field(default_factory=list)
    complete: bool = True
    end_ns: int = 0
    ended_after: int | None = None
    timings: list[bytes] = field(default_factory=list)

    @property
    def event_count(self) -> int:
        return len(self.rows)

    def stamp(self, stamp_ns: int) -> Stamp:
        return Stamp(stamp_ns)

    def metadata(self, name: str) -> dict[str, str]:
        return {"mode": "native"} if self.timings and name == METADATA_NATIVE else {}

    def messages(self, topic: str) -> Iterator[tuple[int, int, bytes]]:
        assert topic == TOPIC_TIMINGS
        return ((0, 0, CDR_HEADER + packed) for packed in self.timings)

    def entity(self, number: int) -> Entity:
        return self.entities[number]

    def add(self, kind: EntityKind, name: str, node: int = 0) -> int:
        number = len(self.entities) + 1
        self.entities[number] = Entity(number, node or number, kind, name, "", 0, {})
        return number

    def _cut(self, dtype: Any, columns: dict[str, int], rows: list[Any], of: int) -> Iterator[Any]:
        for low, high in pairwise((0, *self.cuts, len(self.rows))):
            own = [row for row in rows if low <= row[of] < high]
            made = np.zeros(len(own), dtype=dtype)
            for name, place in columns.items():
                made[name] = [row[place] for row in own]
            yield made

    def events(self) -> Iterator[Any]:
        names = ("index", "stamp", "entity", "kind", "flags", "cause_event", "cause_output")
        return self._cut(EVENT_DTYPE, {name: n for n, name in enumerate(names)}, self.rows, 0)

    def outputs(self) -> Iterator[Any]:
        names = ("event", "kind", "entity", "hash")
        return self._cut(OUTPUT_DTYPE, {name: n for n, name in enumerate(names)}, self.sent, 0)


def random_run(seed: int) -> tuple[Any, list[Sent], list[Sent]]:
    """Return a run in which anything causes anything, its messages, and the ends of its callbacks
    that take a message (as messages that nobody receives), in order."""
    chance, run = random.Random(seed), MadeRun()
    nodes = [run.add(EntityKind.NODE, f"/n{n}") for n in range(NODES)]
    timers = [run.add(EntityKind.TIMER, "tick", node) for node in nodes]
    topics = [f"/t{t}" for t in range(TOPICS)]
    publishers = [
        [(t, run.add(EntityKind.PUBLISHER, t, node)) for t in chance.sample(topics, 2)]
        for node in nodes
    ]
    subscriptions = [
        {t: run.add(EntityKind.SUBSCRIPTION, t, node) for t in topics} for node in nodes
    ]
    messages: list[Sent] = []
    taken: list[Sent] = []
    waiting: dict[int, tuple[Sent, int] | None] = {}
    last: list[dict[str, tuple[Sent, int]]] = [{} for _ in nodes]
    now_ns = 1_000
    for index in range(chance.randint(1, 60)):
        now_ns += chance.randint(0, 3)
        node = chance.randrange(NODES)
        came: tuple[Sent, int] | None = None
        entity, kind, cause = timers[node], EventKind.TIMER, (NO_EVENT, 0)
        choice = chance.choice(("receive", "receive", "receive", "resume", "timer"))
        if choice == "receive" and messages:
            message = chance.choice(messages[-6:])
            entity = subscriptions[node][message.hop.topic]
            now_ns = max(now_ns, message.left_ns + message.delays.get(entity, 0))
            kind, cause, came = EventKind.SUBSCRIPTION, message.cause, (message, now_ns)
            last[node][message.hop.topic] = came
        elif choice == "resume" and waiting:
            entity = chance.choice(list(waiting))
            node = nodes.index(run.entities[entity].node)
            came, kind = waiting.pop(entity), EventKind.RESUME
        busy_ns = chance.randint(0, 4) if kind != EventKind.RESUME else 0
        place = 0
        if busy_ns:
            draw = encode_decision(RandomDecision.EXECUTION, busy_ns)
            run.sent.append((index, OutputKind.DRAW, entity, draw))
            place += 1
        goes_on = entity not in waiting and chance.random() < 0.3
        for topic, publisher in publishers[node][: chance.randint(0, 2)]:
            sent = Sent(Hop(f"/n{node}", topic), (index, place), now_ns + busy_ns, now_ns)
            run.sent.append((index, OutputKind.MESSAGE, publisher, 7))
            place += 1
            if came is not None:
                sent.came, sent.start_ns = came
            sent.last = dict(last[node])
            for other in chance.sample(range(NODES), chance.randint(0, NODES)):
                receiver, delay_ns = subscriptions[other][topic], chance.randint(0, 5)
                draw = encode_decision(RandomDecision.DELAY, delay_ns)
                run.sent.append((index, OutputKind.DRAW, receiver, draw))
                place += 1
                sent.delays[receiver] = delay_ns
            messages.append(sent)
        if goes_on and not busy_ns:
            waiting[entity] = came
        flags = EventFlag.SUSPENDED if goes_on and not busy_ns else EventFlag.NONE
        if came is not None and not flags:
            hop = Hop(f"/n{node}", f"(/n{node})")
            taken.append(Sent(hop, (index, 0), now_ns + busy_ns, now_ns, *came))
        run.rows.append((index, now_ns, entity, kind, flags, *cause))
    run.cuts = sorted(chance.sample(range(len(run.rows)), min(2, len(run.rows))))
    return run, messages, taken


def longest_without_repeats(hops: list[Sent]) -> list[Sent]:
    for first in range(len(hops)):
        names = [one.hop for one in hops[first:]]
        if len(set(names)) == len(names):
            return hops[first:]
    return []


def expected(outputs: list[list[Sent]], inputs: list[Sent]) -> dict[str, list[int]]:
    """The definitions of docs/latency.md, one by one and without any thought of speed."""
    inputs = sorted(inputs, key=lambda one: one.left_ns)  # stable: in the order of publishing
    rank = {id(one): place for place, one in enumerate(inputs)}
    outputs = sorted(outputs, key=lambda hops: hops[-1].left_ns)
    found: dict[str, list[int]] = {name: [] for name in MEASURES}
    for place, hops in enumerate(outputs):
        age = hops[-1].left_ns - hops[0].left_ns
        found["age"].append(age)
        if all(other[0] is not hops[0] for other in outputs[:place]):
            found["latency"].append(age)
        if place + 1 < len(outputs):
            found["last_age"].append(outputs[place + 1][-1].left_ns - hops[0].left_ns)
    for place, one in enumerate(inputs):
        answer = next((hops for hops in outputs if rank[id(hops[0])] >= place), None)
        if answer is not None:
            found["reaction"].append(answer[-1].left_ns - one.left_ns)
            if place:
                before = inputs[place - 1].left_ns
                found["worst_reaction"].append(answer[-1].left_ns - before)
    return found


def assert_measured(chain: ChainLatency, outputs: list[list[Sent]], inputs: list[Sent]) -> None:
    want = expected(outputs, inputs)
    assert {name: chain.durations(name).tolist() for name in MEASURES} == want
    for name, durations in want.items():
        worst = chain.worst(name)
        assert (worst.duration_ns if worst else None) == max(durations, default=None)
        if worst is not None:
            assert worst.output_ns >= worst.input_ns
    ordered = sorted(outputs, key=lambda hops: hops[-1].left_ns)
    assert chain.events().tolist() == [[one.cause[0] for one in hops] for hops in ordered]
    whole = sum(getattr(one, part) for one in chain.parts for part in HopTimes.__slots__)
    assert np.array_equal(whole, chain.found.ages_ns())
    for one in chain.parts:
        assert all((getattr(one, part) >= 0).all() for part in HopTimes.__slots__)


@pytest.mark.repeated
@settings(max_examples=RUNS, deadline=None)
@given(seed=st.integers(0, 10**9))
def test_all_chains_of_random_graphs(seed: int) -> None:
    run, messages, _ = random_run(seed)
    came = [longest_without_repeats(one.hops()) for one in messages]
    names = {tuple(one.hop for one in hops) for hops in came}
    ends = {n for n in names if len(n) > 1 and not any(o[:-1] == n for o in names)}
    found = measure_latencies(run)
    assert {chain.hops for chain in found.chains} == ends
    for chain in found.chains:
        outputs = [hops for hops in came if tuple(o.hop for o in hops) == chain.hops]
        used = [hops[0] for hops in outputs]
        inputs = [
            hops[-1]
            for hops in came
            if (len(hops) == 1 and hops[0].hop == chain.hops[0])
            or any(hops[-1] is one for one in used)
        ]
        assert_measured(chain, outputs, inputs)


def observed(run: Any, messages: list[Sent], ahead_ns: int) -> Any:
    """Return a run as if it had been native: nothing was drawn, but clocks were read. That of the
    system is ``ahead_ns`` of the trace's."""
    busy = {
        event: value & (encode_decision(1) - 1)
        for event, kind, _, value in run.sent
        if kind == OutputKind.DRAW and value // encode_decision(1) == RandomDecision.EXECUTION
    }
    by_place = {message.cause: message for message in messages}
    for index, stamp_ns, entity, _, _, *cause in run.rows:
        source_ns = ready_ns = 0
        if (message := by_place.get(tuple(cause))) is not None:
            source_ns = message.left_ns + ahead_ns
            ready_ns = source_ns + message.delays[entity] if entity in message.delays else 0
        times = (index, stamp_ns, stamp_ns + ahead_ns, busy.get(index, 0), 0, source_ns, ready_ns)
        run.timings.append(TIMING.pack(*times, 0, 1))
    run.sent = [
        (event, OutputKind.TASK if kind == OutputKind.DRAW else kind, *rest)
        for event, kind, *rest in run.sent
    ]
    return run


@pytest.mark.parametrize("seed", range(RUNS))
def test_a_native_run_has_the_latencies_of_the_simulated_one_that_does_the_same(seed: int) -> None:
    simulated, messages, _ = random_run(seed)
    expected_of = {one.hops: one for one in measure_latencies(simulated).chains}
    native = observed(random_run(seed)[0], messages, ahead_ns=10**18)
    for chain in measure_latencies(native).chains:
        other = expected_of.pop(chain.hops)
        for measure in MEASURES:
            assert chain.durations(measure).tolist() == other.durations(measure).tolist()
        for parts, expected_parts in zip(chain.parts, other.parts, strict=True):
            for part in ("link", "queue", "held", "runs"):
                assert getattr(parts, part).tolist() == getattr(expected_parts, part).tolist()
    assert not expected_of


def through(message: Sent, topics: list[str], via: str) -> Iterator[list[Sent]]:
    """Yield the messages that one of the last of ``topics`` came of, by the definition."""
    if message.hop.topic != topics[-1]:
        return
    if len(topics) == 1:
        yield [message]
        return
    parents = [message.came] if message.came is not None else []
    if (
        message.hop.node == via
        and message.hop.topic[0] == "/"
        and (last := message.last.get(topics[-2])) is not None
    ):
        own = message.came is not None and message.came.hop.topic == topics[-2]
        parents += [] if own else [last[0]]
    for parent in parents:
        for hops in through(parent, topics[:-1], via):
            yield [*hops, message]


@pytest.mark.repeated
@settings(max_examples=RUNS, deadline=None)
@given(seed=st.integers(0, 10**9))
@example(seed=439)  # a node that samples has received a newer message, which came of no input
@example(seed=365893)  # a callback goes on with a message that came of no input, after a newer one
def test_a_chain_through_a_node_that_samples(seed: int) -> None:
    run, messages, taken = random_run(seed)
    chance = random.Random(seed)
    known = sorted({one.name for one in run.entities.values() if one.kind is EntityKind.PUBLISHER})
    topics, via = chance.choices(known, k=chance.randint(2, 3)), f"/n{chance.randrange(NODES)}"
    if chance.random() < 0.5:  # the chain ends in a node
        topics[-1] = f"(/n{chance.randrange(NODES)})"
    came = [hops for one in (*messages, *taken) for hops in through(one, topics, via)]
    topics[-1] = topics[-1].strip("()")
    if not came:
        with pytest.raises(TraceError, match=r"no (message|callback) of"):
            measure_latencies(run, topics=topics, via=[via])
        return
    found = measure_latencies(run, topics=topics, via=[via])
    assert sum(chain.outputs for chain in found.chains) == len(came)
    for chain in found.chains:
        outputs = [hops for hops in came if tuple(o.hop for o in hops) == chain.hops]
        assert_measured(chain, outputs, [one for one in messages if one.hop == chain.hops[0]])


def test_an_input_without_an_answer_is_too_late_once_its_time_is_up() -> None:
    run: Any = MadeRun(end_ns=250)
    one, other = (run.add(EntityKind.NODE, name) for name in ("/one", "/other"))
    sends, receives, answers = (
        run.add(kind, topic, node)
        for kind, topic, node in (
            (EntityKind.PUBLISHER, "/a", one),
            (EntityKind.SUBSCRIPTION, "/a", other),
            (EntityKind.PUBLISHER, "/b", other),
        )
    )
    for index, (now_ns, cause) in enumerate(((0, None), (10, 0), (100, None), (200, None))):
        kind = EventKind.TIMER if cause is None else EventKind.SUBSCRIPTION
        entity = sends if cause is None else receives
        run.rows.append((index, now_ns, entity, kind, 0, NO_EVENT if cause is None else cause, 0))
        publisher = sends if cause is None else answers
        run.sent.append((index, OutputKind.MESSAGE, publisher, 7))
    of = {"from": "/a", "to": "/b", "measure": "reaction"}
    for below_ns, late in ((5, [1, 2, 3]), (100, [2]), (200, [])):
        *_, found = check_latency(run, LatencySpec(**of, below_ns=below_ns))
        assert found is not None
        assert [one.event for one in found.violations] == late
    *_, found = check_latency(run, LatencySpec(**of, below_ns=100, quantile=50))
    assert found is not None
    assert found.count == 0, "one of two is answered in time"
    run.ended_after = 1
    *_, found = check_latency(run, LatencySpec(**of, below_ns=5))
    assert found is not None
    assert found.count == 0
    assert found.undecided, "the run had ended"


@settings(max_examples=RUNS, deadline=None)
@given(st.lists(st.integers(0, 50), min_size=1))
def test_quantiles_are_durations_that_so_many_do_not_exceed(durations: list[int]) -> None:
    found = figures(np.array(durations, dtype=np.int64))
    assert found is not None
    for value, percent in ((found.p50_ns, 50), (found.p95_ns, 95), (found.p99_ns, 99)):
        assert value in durations
        assert sum(one <= value for one in durations) >= math.ceil(percent * len(durations) / 100)
        assert sum(one < value for one in durations) < math.ceil(percent * len(durations) / 100)
    assert found.jitter_ns == max(durations) - min(durations)
