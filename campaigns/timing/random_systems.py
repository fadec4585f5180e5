"""Random systems of chains on executors, run by the simulation and held against their bounds."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rclpy.node import Node
from std_msgs.msg import Empty

from rsltrace.job import Job
from rsltrace.native.timing.bounds import ResponseBound, bounds
from rsltrace.native.timing.chains import ChainPath as Chain
from rsltrace.native.timing.chains import ObservedChains
from rsltrace.native.timing.model import ProcessorModel, longest_times, system_of
from rsltrace.run import record
from rsltrace.trace.reader import Trace

POLICIES = ("fifo", "rate_monotonic", "wait_set", "rclpy", "permutation", "priority")
PERIODS_MS = (5, 8, 10, 15, 20, 30, 40, 60, 100)


class Worker(Node):  # type: ignore[misc]
    """Has timers and subscriptions, each of which publishes some topics once."""

    def __init__(
        self,
        name: str,
        timers: list[tuple[int, list[str]]],
        subscriptions: list[tuple[str, list[str]]],
    ) -> None:
        super().__init__(name)
        for number, (period_ms, targets) in enumerate(timers):
            self.create_timer(period_ms / 1000, self._sender(f"timer{number}", targets))
        for topic, targets in subscriptions:
            self.create_subscription(Empty, topic, self._sender(topic, targets), 1000)

    def _sender(self, name: str, targets: list[str]) -> Callable[..., None]:
        publishers = [self.create_publisher(Empty, topic, 1000) for topic in targets]

        def send(*message: Any) -> None:
            for publisher in publishers:
                publisher.publish(Empty())

        send.__qualname__ = name
        return send


@dataclass
class Plan:
    """A system: its job as a mapping, and how its nodes are made."""

    nodes: dict[str, tuple[list[tuple[int, list[str]]], list[tuple[str, list[str]]]]]
    settings: dict[str, Any]
    description: str

    def job(self) -> Job:
        specs = [
            {"node": Worker, "arguments": {"name": name, "timers": t, "subscriptions": s}}
            for name, (t, s) in self.nodes.items()
        ]
        return Job(nodes=specs, **self.settings)


def draw(seed: int) -> Plan:
    """Draw a system: one to three executors, two to six chains of one to five callbacks, which
    branch and meet now and then, executors busy for 20 to 90 % of their time."""
    dice = random.Random(seed)
    executors = dice.randint(1, 3)
    nodes: dict[str, Any] = {f"n{n}": ([], []) for n in range(executors * dice.randint(1, 3))}
    names = list(nodes)
    home = {name: index % executors for index, name in enumerate(names)}
    weights: list[tuple[str, str, float]] = []
    topics = 0
    shared: list[str] = []
    for _ in range(dice.randint(2, 6)):
        period_ms, node = dice.choice(PERIODS_MS), dice.choice(names)
        targets: list[str] = []
        earlier = list(shared)
        timers = nodes[node][0]
        weights.append((node, f"timer{len(timers)}", period_ms))
        timers.append((period_ms, targets))
        for _ in range(dice.randint(0, 4)):
            if earlier and dice.random() < 0.08:
                meets = dice.choice(earlier)  # a chain that meets another, and ends there
                targets.append(meets)
                weights += [
                    (n, topic, period_ms)
                    for n, (_, subscriptions) in nodes.items()
                    for topic, _ in subscriptions
                    if topic == meets
                ]
                break
            topic = f"/t{topics}"
            topics += 1
            targets.append(topic)
            after: list[str] = []
            for _ in range(2 if dice.random() < 0.15 else 1):
                node = dice.choice(names)
                nodes[node][1].append((topic, after if not after else []))
                weights.append((node, topic, period_ms))
                after_here = nodes[node][1][-1][1]
            shared.append(topic)
            targets = after_here
    policy = dice.choice(POLICIES)
    settings: dict[str, Any] = {
        "policy": policy,
        "executors": [
            {"nodes": [f"/{name}" for name in names if home[name] == number], "workers": 1}
            for number in range(executors)
            if any(home[name] == number for name in names)
        ],
        "execution": _execution(dice, weights, home),
        "stop": {"duration": "1s"},
        "seed": seed,
        "record": {"exclude": ["*"]},
    }
    if policy == "priority":
        settings["policy"] = {
            "priority": [
                {"node": f"/{node}", "entity": entity, "priority": dice.randint(0, 9)}
                for node, entity, _ in weights
            ]
        }
    if dice.random() < 0.4:
        longest = dice.choice(("0.1ms", "1ms", "3ms"))
        settings["delay"] = {"default": {"uniform": {"min": "0ms", "max": longest}}}
    return Plan(nodes, settings, f"seed {seed}, {policy}, {executors} executors")


def _execution(
    dice: random.Random, weights: list[tuple[str, str, float]], home: dict[str, int]
) -> dict[str, Any]:
    """Give each callback a part of its executor's time, and a time up to that."""
    entities = []
    for executor in set(home.values()):
        mine = [one for one in weights if home[one[0]] == executor]
        parts = [dice.random() + 0.05 for _ in mine]
        load = dice.uniform(0.2, 0.9)
        rates: dict[tuple[str, str], float] = {}
        for node, entity, period_ms in mine:
            rates[node, entity] = rates.get((node, entity), 0.0) + 1 / period_ms
        for ((node, entity), rate), part in zip(rates.items(), parts, strict=False):
            longest_us = max(int(1000 / rate * load * part / sum(parts)), 1)
            least_us = longest_us if dice.random() < 0.5 else dice.randint(0, longest_us)
            entities.append(
                {
                    "node": f"/{node}",
                    "entity": entity,
                    "uniform": {"min": f"{least_us}us", "max": f"{longest_us}us"},
                }
            )
    return {"entities": entities}


def held(plan: Plan, folder: Path) -> list[tuple[Chain, ResponseBound]]:
    """Run a system; return its chains, up to each of their callbacks, with their bounds."""
    job = plan.job()
    record(job, folder / "run.mcap", force=True)
    with Trace.open(folder / "run.mcap") as trace:
        observed = ObservedChains(trace)
        times, notes = longest_times(job, observed)
        assert not notes
        system, _ = system_of(job, observed, times, ProcessorModel())
        return list(zip(observed.paths, bounds(system), strict=True))
