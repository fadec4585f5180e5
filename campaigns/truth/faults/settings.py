"""Keys of the job that matter: the report names the key and both values."""

from __future__ import annotations

import random
import re
from functools import partial
from typing import Any

from campaigns.truth.faults.planting import (
    ALWAYS_FALSE,
    NOT_DETERMINISTIC,
    Planted,
    Truth,
    fault,
    one_of,
)
from campaigns.truth.graph import Callback, NodePlan, World, random_world

NEVER = (*ALWAYS_FALSE, NOT_DETERMINISTIC)
_truth = partial(Truth, never=NEVER)


def changed(a: World, key: str, value: Any) -> World:
    """Return a world with another value of a top-level key of the job."""
    b = a.copy()
    b.job[key] = value
    return b


@fault("parameter value")
def parameter(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    b = a.copy()
    value = node.parameters["gain"] + rng.choice((0.05, 1.0))
    b.entry(node.name)["parameters"]["gain"] = value
    says = (r"gain", rf"{node.parameters['gain']}\b.*{re.escape(str(value))}")
    return Planted(a, b, _truth(("environment",), node.full_name, says=says))


@fault("constant in code")
def constant(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    b = a.copy()
    lines = b.node(node.name).callbacks[0].lines
    lines[0] = lines[0].replace("0.25", "0.26")
    topic = node.callbacks[0].publishes
    return Planted(
        a,
        b,
        _truth(
            ("same-input-different-output",),
            node.full_name,
            node.callbacks[0].entity,
            first=(topic,),
            says=(rf"code of module {node.module}",),
            values=node.callbacks[0].publishes,
        ),
    )


@fault("period in code")
def period(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    b = a.copy()
    was = node.callbacks[0].period_ms
    now = was + rng.choice((-4, 1, 6))
    setup = b.node(node.name).setup
    setup[-1] = setup[-1].replace(str(was / 1000), str(now / 1000))
    return Planted(
        a,
        b,
        _truth(
            ("timing", "extra", "missing"),
            node.full_name,
            node.callbacks[0].entity,
            first=(rf"period.*{was} → {now} ms",),
            says=(rf"code of module {node.module}",),
        ),
    )


@fault("seed of nodes that draw")
def seed(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    node.callbacks[0].lines.insert(1, "value = value + random.random()")
    b = changed(a, "seed", a.job["seed"] + 1)
    truth = Truth(
        ("same-input-different-output",),
        node.full_name,
        node.callbacks[0].entity,
        says=(r"\bseed\b",),
        never=(*NEVER, r"code of module"),
        values=node.callbacks[0].publishes,
    )
    return Planted(a, b, truth)


@fault("delay that is drawn, seed")
def drawn_delay(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "relay")
    a.job["delay"] = {"topics": {node.hears[0]: {"uniform": {"min": "1ms", "max": "9ms"}}}}
    b = changed(a, "seed", a.job["seed"] + 1)
    truth = Truth(
        ("draw",),
        says=(r"\bseed\b", r"delay"),
        never=(NOT_DETERMINISTIC, r"different number of times"),
    )
    return Planted(a, b, truth)


@fault("constant delay")
def constant_delay(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "relay")
    topic = node.hears[0]
    a.job["delay"] = {"topics": {topic: "2ms"}}
    b = changed(a, "delay", {"topics": {topic: "5ms"}})
    first = (r"2 ms.* 5 ms", re.escape(topic))
    return Planted(a, b, _truth(("draw", "timing"), first=first, says=(r"delay",)))


@fault("delay that only one run has")
def new_delay(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "relay")
    topic = node.hears[0]
    b = changed(a, "delay", {"topics": {topic: "4ms"}})
    first = (r"4 ms", re.escape(topic))
    return Planted(a, b, _truth(("draw", "timing"), first=first, says=(r"delay",)))


@fault("delay of all topics")
def default_delay(rng: random.Random) -> Planted:
    a = random_world(rng)
    a.job["delay"] = {"default": "1ms"}
    b = changed(a, "delay", {"default": "3ms"})
    return Planted(a, b, _truth(("draw", "timing"), first=(r"1 ms.* 3 ms",), says=(r"delay",)))


@fault("execution time")
def execution(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "relay", "source")
    a.job["execution"] = {"nodes": {node.full_name: "1ms"}}
    b = changed(a, "execution", {"nodes": {node.full_name: "3ms"}})
    return Planted(
        a,
        b,
        _truth(("draw", "timing"), node.full_name, first=(r"1 ms.* 3 ms",), says=(r"execution",)),
    )


@fault("outage")
def outage(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "relay")
    outages = [{"node": node.full_name, "from": "100ms", "to": "200ms"}]
    a.job["delay"] = {"default": 0}
    b = changed(a, "delay", {"default": 0, "outages": outages})
    return Planted(a, b, _truth(("draw", "timing", "missing"), says=(r"outage",)))


@fault("loss")
def loss(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "relay")
    topic = node.hears[0]
    setup = node.setup
    at = next(i for i, line in enumerate(setup) if "create_subscription" in line)
    setup[at] = (
        f'self.subscription = self.create_subscription(Float64, "{topic}", self.heard, '
        "QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))"
    )
    link = {"topic": topic, "to": node.full_name, "constant": 0}
    a.job["delay"] = {"links": [{**link, "drop": 0.0}]}
    b = changed(a, "delay", {"links": [{**link, "drop": 0.6}]})
    return Planted(
        a,
        b,
        Truth(
            ("draw", "missing"),
            first=(r"lost", re.escape(topic)),
            says=(r"drop",),
            never=(NOT_DETERMINISTIC, r"different number of times"),
        ),
    )


def _two_sources(rng: random.Random) -> tuple[World, NodePlan]:
    """Return a world with a source more, which ticks together with the first."""
    a = random_world(rng)
    first = a.node("source0")
    tick = first.callbacks[0]
    more = NodePlan(
        "twin",
        "source",
        [
            'self.out = self.create_publisher(Float64, "/twin", 10)',
            f"self.timer = self.create_timer({tick.period_ms / 1000}, self.tick)",
        ],
        [
            Callback(
                "tick",
                "timer",
                "Twin.tick",
                ["value = 1.0", "# before", "self.out.publish(Float64(data=value))", "# after"],
                "/twin",
                tick.period_ms,
            )
        ],
    )
    a.nodes.append(more)
    a.job["nodes"].append({"node": f"{more.module}:{more.class_name}"})
    return a, more


@fault("policy")
def policy(rng: random.Random) -> Planted:
    a, _ = _two_sources(rng)
    b = changed(a, "policy", {"priority": [{"node": "/twin", "priority": rng.randint(1, 9)}]})
    return Planted(a, b, _truth(("schedule",), says=(r"policy",), independent=None))


@fault("order of the nodes")
def node_order(rng: random.Random) -> Planted:
    a, _ = _two_sources(rng)
    b = a.copy()
    b.job["nodes"].reverse()
    return Planted(a, b, _truth(("graph", "schedule"), says=(r"order",), independent=None))


@fault("executors")
def executors(rng: random.Random) -> Planted:
    a, twin = _two_sources(rng)
    a.job["execution"] = {"nodes": {twin.full_name: "3ms", "/source0": "3ms"}}
    b = changed(a, "executors", "single_threaded")
    return Planted(a, b, _truth(("timing", "schedule"), says=(r"executors",), independent=None))


@fault("smallest time step")
def time_step(rng: random.Random) -> Planted:
    a = random_world(rng)
    b = changed(a, "min_time_step", "61ms")
    return Planted(a, b, _truth(("timing",), says=(r"min_time_step",), independent=None))


@fault("start")
def start(rng: random.Random) -> Planted:
    a = random_world(rng)
    a.bag.clear()
    a.nodes = [node for node in a.nodes if "/b0" not in node.hears]
    a.job["start"] = "0s"
    b = changed(a, "start", "1s")
    return Planted(a, b, _truth(says=(r"\bstart\b",), independent=None))


@fault("clock of a node")
def clock(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    node.callbacks[0].lines.insert(1, "value = value + self.get_clock().now().nanoseconds * 1e-9")
    a.job["clocks"] = [{"node": node.full_name, "offset": "1ms"}]
    b = changed(a, "clocks", [{"node": node.full_name, "offset": "3ms"}])
    return Planted(a, b, _truth(says=(r"clocks",)))


@fault("on_exception")
def on_exception(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    lines = node.callbacks[0].lines
    lines[lines.index("# after")] = 'if self.n == 3: raise RuntimeError("planted")'
    a.entry(node.name)["on_exception"] = "stop"
    b = a.copy()
    b.entry(node.name)["on_exception"] = "log"
    return Planted(a, b, _truth(says=(r"on_exception",), independent=None))
