"""Other nodes, other names: what is constructed differs."""

from __future__ import annotations

import random
import re
from dataclasses import replace
from functools import partial

from campaigns.truth.faults.planting import Planted, Truth, fault, one_of
from campaigns.truth.faults.settings import NEVER
from campaigns.truth.graph import NodePlan, random_world

GRAPH = ("graph",)
_truth = partial(Truth, GRAPH, never=NEVER, independent=None)


@fault("renamed node")
def renamed(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source", "relay", "sink")
    b = a.copy()
    b.entry(node.name)["name"] = "other_name"
    truth = _truth(first=(rf"{node.full_name} .*renamed to /other_name",), says=(r"name",))
    return Planted(a, b, truth)


@fault("renamed node in code")
def renamed_in_code(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source", "relay", "sink")
    b = a.copy()
    other = b.node(node.name)
    text = f"super().__init__({node.name!r})"
    other.setup.insert(0, "pass")
    _rename(other, text)
    truth = _truth(
        first=(rf"{node.full_name} .*renamed to /other_name",),
        says=(rf"code of module {node.module}",),
    )
    return Planted(a, b, truth)


def _rename(node: NodePlan, text: str) -> None:
    made = node.source

    def source() -> str:
        return made().replace(text, "super().__init__('other_name')")

    node.source = source  # type: ignore[method-assign]


@fault("namespace")
def namespace(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source", "relay", "sink")
    b = a.copy()
    b.entry(node.name)["namespace"] = "/robot"
    truth = _truth(
        first=(rf"{node.full_name} .*renamed to /robot{node.full_name}",), says=(r"namespace",)
    )
    return Planted(a, b, truth)


@fault("remapped topic")
def remapped(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    topic = node.callbacks[0].publishes
    b = a.copy()
    b.entry(node.name)["remappings"] = {topic: "/elsewhere"}
    truth = _truth(
        node.full_name, first=(rf"{re.escape(topic)}.*/elsewhere",), says=(r"remappings",)
    )
    return Planted(a, b, truth)


@fault("topic in code")
def topic_in_code(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    topic = node.callbacks[0].publishes
    b = a.copy()
    b.node(node.name).setup = [
        line.replace(f'"{topic}"', '"/elsewhere"') for line in b.node(node.name).setup
    ]
    truth = _truth(
        node.full_name,
        first=(rf"{re.escape(topic)}.*/elsewhere",),
        says=(rf"code of module {node.module}",),
    )
    return Planted(a, b, truth)


def _spare(name: str) -> NodePlan:
    return NodePlan(name, "spare", ["self.timer = self.create_timer(0.1, lambda: None)"], [])


@fault("extra node")
def extra(rng: random.Random) -> Planted:
    a = random_world(rng)
    b = a.copy()
    b.nodes.append(_spare("spare"))
    at = rng.randint(0, len(b.job["nodes"]))
    b.job["nodes"].insert(at, {"node": "truth_spare:Spare"})
    truth = _truth(first=(r"/spare is constructed in b but not in a",), says=(r"nodes",))
    return Planted(a, b, truth)


@fault("missing node")
def missing(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "sink", "source", "relay")
    b = a.copy()
    b.job["nodes"].remove(b.entry(node.name))
    truth = _truth(first=(rf"{node.full_name} is constructed in a but not in b",), says=(r"nodes",))
    return Planted(a, b, truth)


@fault("extra publisher in code")
def publisher(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source", "relay", "sink")
    b = a.copy()
    b.node(node.name).setup.append('self.more = self.create_publisher(Float64, "/more", 10)')
    truth = _truth(
        node.full_name, first=(r"/more only in b",), says=(rf"code of module {node.module}",)
    )
    return Planted(a, b, truth)


@fault("extra subscription in code")
def subscription(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "sink")
    b = a.copy()
    b.node(node.name).setup.append(
        'self.more = self.create_subscription(Float64, "/s0", lambda message: None, 10)'
    )
    truth = _truth(
        node.full_name, first=(r"/s0 only in b",), says=(rf"code of module {node.module}",)
    )
    return Planted(a, b, truth)


@fault("extra parameter")
def parameter(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source", "relay", "sink")
    b = a.copy()
    b.node(node.name).setup.append('self.declare_parameter("more", 5)')
    truth = Truth(
        node=node.full_name,
        first=(rf"parameter more of {node.full_name} 5 only in b",),
        says=(rf"code of module {node.module}",),
        never=NEVER,
        independent=None,
    )
    return Planted(a, b, truth)


@fault("different jobs")
def different(rng: random.Random) -> Planted:
    a = random_world(rng)
    b = random_world(rng)
    a.bag.clear()
    b.bag.clear()
    for number, node in enumerate(b.nodes):
        b.entry(node.name)["name"] = f"other{number}"
    truth = Truth(first=(r"different jobs",), never=(), independent=None)
    return Planted(a, b, truth)


@fault("two nodes with each other's names")
def exchanged(rng: random.Random) -> Planted:
    a = random_world(rng)
    one, other = a.node("source0"), a.node("sink")
    a.entry(one.name)["name"], a.entry(other.name)["name"] = "first", "second"
    b = a.copy()
    b.entry(one.name)["name"], b.entry(other.name)["name"] = "second", "first"
    truth = Truth(says=("name", "/first", "/second"), never=NEVER, independent=None)
    return Planted(a, b, truth)


def _declared(name: str, one: str, other: str, *says: str) -> None:
    """Register a class: a node declares its parameter otherwise, in its code."""

    @fault(name)
    def planter(rng: random.Random) -> Planted:
        a = random_world(rng)
        node = one_of(rng, a, "source")
        a.entry(node.name).pop("parameters", None)
        b = a.copy()
        for world, text in ((a, one), (b, other)):
            world.node(node.name).setup[0] = f'self.declare_parameter("gain", {text})'
        cause = rf"code of module {node.module}"
        truth = Truth((), node.full_name, says=(cause, *says), never=NEVER, independent=None)
        return Planted(a, b, truth)


_declared("default of a parameter", "1.5", "1.75", "/s", r"gain of /source\d 1\.5 → 1\.75")
_declared("type of a parameter", "2", "2.0", r"gain of /source\d 2 → 2\.0")


@fault("parameter of all nodes")
def wildcard(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    for name in [n.name for n in a.nodes]:
        a.entry(name).pop("parameters", None)
    text = "/**:\n  ros__parameters:\n    gain: {}\n"
    a.files["all.yaml"] = text.format(2.5)
    a.entry(node.name)["parameter_files"] = ["all.yaml"]
    b = a.copy()
    b.files["all.yaml"] = text.format(2.75)
    truth = Truth(
        (), node.full_name, says=(r"gain 2\.5 → 2\.75", r"all\.yaml"), never=NEVER, independent=None
    )
    return Planted(a, b, truth)


@fault("service of another name")
def service_name(rng: random.Random) -> Planted:
    a = random_world(rng, service=True)
    b = a.copy()
    b.entry("server")["remappings"] = {"/ask": "/ask_me"}
    first = (r"/ask\b.*/ask_me",)
    truth = Truth(GRAPH, "/server", first=first, says=("remappings",), never=NEVER)
    return Planted(a, b, replace(truth, independent=None))
