"""How often PCT meets a planted order, beside its bound: 10,000 runs for each depth.

    python benchmarks/explore_pct.py                    depths 1 to 3
    python benchmarks/explore_pct.py --runs 1000 --depths 2

Three nodes get four messages each at one instant. An order of depth d takes d constraints of the
kind "this message before that one". Seeds are 1, 2, 3, …, so the same counts come every time.

A run of ten events takes a hundred times as long to set up as to make. So the nodes are made once,
and get their messages again for each seed, with a new policy; the first seeds are also run one by
one, as a job of their own each, and have to meet the same orders.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from std_msgs.msg import UInt8

from rsltrace import Simulation
from rsltrace.job import Job
from rsltrace.run.session import RunSession
from rsltrace.search.explore.steps import TrialObserver
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.simulation.loop.policy import Pct, pct_bound

TOPICS = ("a", "b", "c")
MESSAGES = 4
CONSTRAINTS = {
    1: ["b1 a1"],
    2: ["a2 b1", "b1 a3"],
    3: ["a2 b1", "b1 a3", "a3 b2"],
}
"""Of each depth what comes before what: ``b1`` is the first message on topic b."""

CHECKED = 20
"""So many seeds are also run one by one."""

handled: list[str] = []
"""What has been received in the run under way, in order."""


class Source(Node):
    """Publishes everything in one callback: a1, b1, c1, a2, …"""

    def __init__(self) -> None:
        super().__init__("source", start_parameter_services=False)
        self.topics = [self.create_publisher(UInt8, topic, MESSAGES) for topic in TOPICS]
        self.timer = self.create_timer(0.1, self.burst)

    def burst(self) -> None:
        for number in range(1, MESSAGES + 1):
            for publisher in self.topics:
                publisher.publish(UInt8(data=number))


class Sink(Node):
    """Notes what it receives."""

    def __init__(self, topic: str) -> None:
        super().__init__(f"sink_{topic}", start_parameter_services=False)
        self.topic = topic
        self.create_subscription(UInt8, topic, self.take, MESSAGES)

    def take(self, message: UInt8) -> None:
        handled.append(f"{self.topic}{message.data}")


class SinkA(Sink):
    def __init__(self) -> None:
        super().__init__("a")


class SinkB(Sink):
    def __init__(self) -> None:
        super().__init__("b")


class SinkC(Sink):
    def __init__(self) -> None:
        super().__init__("c")


@dataclass(frozen=True)
class Count:
    """How often an order was met in so many runs, of how many choices and entities."""

    depth: int
    runs: int
    met: int
    choices: int
    entities: int

    @property
    def bound(self) -> float:
        """The least probability of one run, as ``rsltrace explore`` prints it."""
        return pct_bound(self.entities, self.choices, self.depth)

    @property
    def chance(self) -> float:
        """How likely so few would be, or fewer, if a run met it with the bound's probability."""
        log_p, log_q = math.log(self.bound), math.log1p(-self.bound)
        terms = (
            math.lgamma(self.runs + 1)
            - math.lgamma(met + 1)
            - math.lgamma(self.runs - met + 1)
            + met * log_p
            + (self.runs - met) * log_q
            for met in range(self.met + 1)
        )
        return min(sum(map(math.exp, terms)), 1.0)


def job(policy: Mapping[str, Any], seed: int, bursts: int = 1) -> Job:
    """Return the job that runs so many times in one."""
    return Job(
        nodes=[{"node": kind} for kind in (Source, SinkA, SinkB, SinkC)],
        policy=dict(policy),
        seed=seed,
        stop={"duration": f"{100 * bursts + 50}ms"},
        guard=False,
    )


def run(policy: Mapping[str, Any], seed: int) -> tuple[list[str], TrialObserver]:
    """Run the nodes once; return what they have received, and what there was to choose."""
    handled.clear()
    with RunSession(job(policy, seed), None) as session:
        watch = TrialObserver(session, steps=False)
        session.begin()
        session.go_on()
        session.finish()
    return list(handled), watch


def orders(depth: int, choices: int, runs: int) -> Iterator[list[str]]:
    """Yield the order of each seed, from 1."""
    with Simulation(job({"departures": []}, 0, runs)) as sim:
        for seed in range(1, runs + 1):
            sim._session.loop.policy = Pct(RandomStream(seed, "pct"), depth, choices)
            handled.clear()
            while not handled and sim.step():
                pass
            assert len(handled) == len(TOPICS) * MESSAGES
            yield list(handled)


def is_met(order: list[str], depth: int) -> bool:
    """Say whether all constraints of the order of a depth hold."""
    places = {what: place for place, what in enumerate(order)}
    pairs = (one.split() for one in CONSTRAINTS[depth])
    return all(places[first] < places[second] for first, second in pairs)


def count(depth: int, runs: int) -> Count:
    """Make the runs, and count those that meet the order of that depth."""
    plain, watch = run({"departures": []}, 0)
    assert not is_met(plain, depth), "the plain order does not meet it"
    choices = len(watch.order)
    policy = {"pct": {"depth": depth, "choices": choices}}
    checked: list[list[str]] = []
    met = 0
    for seed, order in enumerate(orders(depth, choices, runs), 1):
        met += is_met(order, depth)
        if seed <= CHECKED:
            checked.append(order)
    alone = [run(policy, seed)[0] for seed in range(1, len(checked) + 1)]
    assert checked == alone, "a run of its own is another one"
    return Count(depth, runs, met, choices, len(watch.entities))


def main() -> None:
    """Count, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--depths", type=int, nargs="+", default=list(CONSTRAINTS))
    options = parser.parse_args()
    print("| depth | entities | choices | bound | met | share |\n|---|---|---|---|---|---|")
    less = False
    for depth in options.depths:
        found = count(depth, options.runs)
        less |= found.chance < 0.001
        print(
            f"| {depth} | {found.entities} | {found.choices} | {found.bound:.4f} | {found.met} of "
            f"{found.runs} | {found.met / found.runs:.4f} |",
            flush=True,
        )
    sys.exit("less often than the bound" if less else 0)


if __name__ == "__main__":
    main()
