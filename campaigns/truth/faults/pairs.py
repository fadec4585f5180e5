"""Two faults at once: the one that shows first leads, and both are told if they are apart."""

from __future__ import annotations

import random
from dataclasses import replace

from campaigns.truth.faults.behaviour import truth_of
from campaigns.truth.faults.planting import (
    NOT_DETERMINISTIC,
    Planted,
    Truth,
    fault,
    in_hiding,
    insert,
    one_of,
)
from campaigns.truth.faults.settings import NEVER, _two_sources, changed
from campaigns.truth.graph import NodePlan, World


def _apart(rng: random.Random) -> tuple[World, World, NodePlan, NodePlan]:
    """Return worlds with a fault in a source, and one some calls later in its twin."""
    a, twin = _two_sources(rng)
    source = a.node("source0")
    early, late = (source, twin) if rng.random() < 0.5 else (twin, source)
    at = rng.randint(1, 3)
    for node, call in ((early, at), (late, at + 2)):
        lines = [f'if hidden() == "fault" and self.n == {call}:', "    value = value + 1.0"]
        insert(node.callbacks[0], "# before", lines)
    b = a.copy()
    b.hidden = "fault"
    return a, b, early, late


@fault("two faults in nodes apart")
def two(rng: random.Random) -> Planted:
    a, b, early, late = _apart(rng)
    topic = early.callbacks[0].publishes
    truth = truth_of(
        early,
        first=(topic,),
        says=(NOT_DETERMINISTIC,),
        values=topic,
        independent=2,
        shows=(rf"independent divergence 2|{late.callbacks[0].publishes}",),
    )
    return Planted(a, b, truth)


@fault("fault, and an exception later")
def exception_later(rng: random.Random) -> Planted:
    a, b, early, late = _apart(rng)
    for world in (a, b):
        lines = ['if hidden() == "fault" and self.n == 6:', '    raise RuntimeError("planted")']
        insert(world.node(late.name).callbacks[0], "# before", lines)
    topic = early.callbacks[0].publishes
    truth = truth_of(early, first=(topic,), says=(r"RuntimeError|exit code 1",), values=topic)
    return Planted(a, b, replace(truth, independent=None))


@fault("parameter, and a fault elsewhere")
def parameter(rng: random.Random) -> Planted:
    a, b, _, _ = _apart(rng)
    node = a.node("source0")
    b.entry(node.name)["parameters"]["gain"] = node.parameters["gain"] + 1.0
    says = (r"gain", rf"{node.parameters['gain']}")
    return Planted(a, b, Truth(("environment",), node.full_name, says=says, independent=None))


@fault("fault, and an end that comes earlier")
def ends_earlier(rng: random.Random) -> Planted:
    a, b, early, _ = _apart(rng)
    b.job["stop"] = {"duration": "350ms"}
    topic = early.callbacks[0].publishes
    truth = truth_of(early, first=(topic,), says=(NOT_DETERMINISTIC,), values=topic)
    never = (*truth.never, r"stop\.")
    return Planted(a, b, replace(truth, never=never, independent=None))


@fault("delay, and a fault before it")
def delay_later(rng: random.Random) -> Planted:
    a, twin = _two_sources(rng)
    relay = one_of(rng, a, "relay")
    a.job["delay"] = {"default": 0}
    b = in_hiding(a, twin.name, ["value = value + 1.0"], at=1)
    outage = {"node": relay.full_name, "from": "200ms", "to": "300ms"}
    b = changed(b, "delay", {"default": 0, "outages": [outage]})
    topic = twin.callbacks[0].publishes
    truth = truth_of(a.node("twin"), first=(topic,), says=(NOT_DETERMINISTIC,), values=topic)
    never = (*truth.never, r"outage")
    return Planted(a, b, replace(truth, never=never, independent=None))


@fault("code of a node, and of another one")
def two_codes(rng: random.Random) -> Planted:
    a, twin = _two_sources(rng)
    b = a.copy()
    insert(b.node("source0").callbacks[0], "# before", ["if self.n == 4:", "    value = 0.5"])
    insert(b.node("twin").callbacks[0], "# before", ["if self.n == 2:", "    value = 0.5"])
    topic = twin.callbacks[0].publishes
    truth = truth_of(
        twin,
        first=(topic,),
        says=(r"code of module truth_twin",),
        never=(*NEVER, r"truth_source0"),
        values=topic,
        independent=2,
    )
    return Planted(a, b, truth)
