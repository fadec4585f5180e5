"""More keys of the job: links, bursts, drawn orders, clocks, bags, parameters from elsewhere."""

from __future__ import annotations

import random
import re
from functools import partial
from typing import Any

from campaigns.truth.faults.planting import NOT_DETERMINISTIC, Planted, Truth, fault, one_of
from campaigns.truth.faults.settings import NEVER, _two_sources, changed
from campaigns.truth.graph import NodePlan, World, random_world

DRAWN = (NOT_DETERMINISTIC, r"different number of times")


def _best_effort(node: NodePlan) -> None:
    place = next(i for i, line in enumerate(node.setup) if "create_subscription" in line)
    node.setup[place] = (
        f'self.subscription = self.create_subscription(Float64, "{node.hears[0]}", self.heard, '
        "QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))"
    )


def _link(
    rng: random.Random, a_rule: dict[str, Any], b_rule: dict[str, Any]
) -> tuple[World, World, NodePlan]:
    a = random_world(rng)
    node = one_of(rng, a, "relay")
    _best_effort(node)
    link = {"topic": node.hears[0], "to": node.full_name, "constant": 0}
    a.job["delay"] = {"links": [{**link, **a_rule}]}
    return a, changed(a, "delay", {"links": [{**link, **b_rule}]}), node


_truth = partial(Truth, never=NEVER, independent=None)


@fault("second copies")
def copies(rng: random.Random) -> Planted:
    a, b, node = _link(rng, {"duplicate": 0.0}, {"duplicate": 0.7})
    first = (r"second copy|twice", re.escape(node.hears[0]))
    truth = Truth(("draw", "extra"), first=first, says=(r"duplicate",), never=DRAWN)
    return Planted(a, b, truth)


@fault("loss in bursts")
def bursts(rng: random.Random) -> Planted:
    burst = {"burst": {"good_to_bad": 0.6, "bad_to_good": 0.4}}
    a, b, node = _link(rng, {}, burst)
    first = (r"lost in a burst", re.escape(node.hears[0]))
    truth = Truth(("draw", "missing"), first=first, says=(r"burst",), never=DRAWN)
    return Planted(a, b, truth)


@fault("delay of one link")
def link_delay(rng: random.Random) -> Planted:
    a, b, node = _link(rng, {"constant": "1ms"}, {"constant": "4ms"})
    first = (r"1 ms.* 4 ms", re.escape(node.hears[0]))
    return Planted(a, b, Truth(("draw", "timing"), first=first, says=(r"delay",), never=NEVER))


@fault("bounds of a drawn delay")
def bounds(rng: random.Random) -> Planted:
    a = random_world(rng)
    topic = one_of(rng, a, "relay").hears[0]
    a.job["delay"] = {"topics": {topic: {"uniform": {"min": "1ms", "max": "4ms"}}}}
    b = changed(a, "delay", {"topics": {topic: {"uniform": {"min": "5ms", "max": "9ms"}}}})
    first = (r"delay \d", re.escape(topic))
    return Planted(a, b, Truth(("draw", "timing"), first=first, says=(r"delay",), never=DRAWN))


@fault("delay of 0 ns")
def no_delay(rng: random.Random) -> Planted:
    a = random_world(rng)
    topic = one_of(rng, a, "relay").hears[0]
    b = changed(a, "delay", {"topics": {topic: "0ms"}})
    first = (r"no effect: one run only adds delays of 0 ns",)
    return Planted(a, b, Truth(("draw",), first=first, says=(r"delay",), never=DRAWN))


@fault("delay of a service")
def service_delay(rng: random.Random) -> Planted:
    a = random_world(rng, service=True)
    a.job["delay"] = {"services": {"/ask": "1ms"}}
    b = changed(a, "delay", {"services": {"/ask": "3ms"}})
    first = (r"1 ms.* 3 ms", "/ask")
    truth = _truth(("draw", "timing"), first=first, says=(r"delay",))
    return Planted(a, b, truth)


@fault("execution time of all")
def execution(rng: random.Random) -> Planted:
    a = random_world(rng)
    a.job["execution"] = {"default": "100us"}
    b = changed(a, "execution", {"default": "300us"})
    first = (r"100 (us|µs).* 300 (us|µs)",)
    truth = _truth(("draw", "timing"), first=first, says=(r"execution",))
    return Planted(a, b, truth)


@fault("execution time of one callback")
def execution_of_one(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    rule = {"node": node.full_name, "entity": node.callbacks[0].entity}
    a.job["execution"] = {"entities": [{**rule, "constant": "1ms"}]}
    b = changed(a, "execution", {"entities": [{**rule, "constant": "2ms"}]})
    truth = Truth(
        ("draw", "timing"),
        node.full_name,
        first=(r"1 ms.* 2 ms",),
        says=(r"execution",),
        never=NEVER,
    )
    return Planted(a, b, truth)


@fault("seed of a drawn order")
def permutation(rng: random.Random) -> Planted:
    a, _ = _two_sources(rng)
    a.job["policy"] = "permutation"
    b = changed(a, "seed", a.job["seed"] + 1)
    truth = _truth(("schedule",), says=(r"\bseed\b",))
    return Planted(a, b, truth)


@fault("clock that drifts")
def drift(rng: random.Random) -> Planted:
    return _clock(rng, {"drift": "0ppm"}, {"drift": "500ppm"})


@fault("clock that jumps")
def jump(rng: random.Random) -> Planted:
    jumps = {"jumps": [{"at": "100ms", "by": "-50ms"}]}
    return _clock(rng, {"offset": "0ms"}, jumps)


def _clock(rng: random.Random, a_rule: dict[str, Any], b_rule: dict[str, Any]) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    node.callbacks[0].lines.insert(1, "value = value + self.get_clock().now().nanoseconds * 1e-9")
    a.job["clocks"] = [{"node": node.full_name, **a_rule}]
    b = changed(a, "clocks", [{"node": node.full_name, **b_rule}])
    return Planted(a, b, Truth((), node.full_name, says=(r"clocks",), never=NEVER))


def _bag(rng: random.Random, options: dict[str, Any], *says: str) -> Planted:
    a = random_world(rng, bag=True)
    b = a.copy()
    b.bag_options = options
    return Planted(a, b, _truth((), says=(r"bags?\b", *says)))


@fault("bag: rate")
def rate(rng: random.Random) -> Planted:
    return _bag(rng, {"rate": 2.0}, r"rate", r"2")


@fault("bag: offset")
def offset(rng: random.Random) -> Planted:
    return _bag(rng, {"start_offset": "40ms"}, r"start_offset")


@fault("bag: other name of a topic")
def renamed(rng: random.Random) -> Planted:
    return _bag(rng, {"remappings": {"/b0": "/elsewhere"}}, r"remappings")


@fault("parameter from the command line")
def from_command_line(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    a.job["ros_arguments"] = ["-p", f"{node.name}:gain:=2.5"]
    b = changed(a, "ros_arguments", ["-p", f"{node.name}:gain:=2.75"])
    truth = _truth((), node.full_name, says=(r"ros_arguments|gain",))
    return Planted(a, b, truth)


@fault("parameter file")
def parameter_file(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    entry = a.entry(node.name)
    entry.pop("parameters", None)
    text = node.full_name + ":\n  ros__parameters:\n    gain: {}\n"
    a.files |= {"one.yaml": text.format(2.5), "other.yaml": text.format(2.75)}
    entry["parameter_files"] = ["one.yaml"]
    b = a.copy()
    b.entry(node.name)["parameter_files"] = ["other.yaml"]
    truth = _truth((), node.full_name, says=(r"parameter_files|gain",))
    return Planted(a, b, truth)


@fault("node that starts later")
def starts_later(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    b = a.copy()
    b.entry(node.name)["start_after"] = {"delay": "50ms"}
    return Planted(a, b, _truth(says=(r"start_after",)))
