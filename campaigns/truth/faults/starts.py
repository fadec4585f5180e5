"""Faults in runs in which nodes start, or start again, while the others go on."""

from __future__ import annotations

import random

from campaigns.truth.faults.behaviour import Change, behaviour, truth_of
from campaigns.truth.faults.planting import NOT_DETERMINISTIC, Planted, Truth, fault, one_of
from campaigns.truth.graph import NodePlan, World, random_world

NEVER = (NOT_DETERMINISTIC,)


def _late(rng: random.Random, world: World, node: NodePlan) -> None:
    world.entry(node.name)["start_after"] = {"delay": f"{rng.choice((55, 120, 205))}ms"}


def _value(rng: random.Random, node: NodePlan, last: int) -> Change:
    topic = node.callbacks[0].publishes
    truth = truth_of(node, first=(topic,), values=topic)
    return Change(node, ["value = value + 0.125"], truth, at=rng.randint(1, last))


@behaviour("value, and other nodes that start later")
def before_others(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    for other in world.nodes:
        if other is not node and rng.random() < 0.7:
            _late(rng, world, other)
    return _value(rng, node, 6)


@behaviour("value of a node that starts later")
def of_late_node(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    _late(rng, world, node)
    return _value(rng, node, 3)


@behaviour("value, and a node that starts again")
def before_a_restart(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    again = rng.choice([other for other in world.nodes if other is not node])
    pause = rng.choice(("0s", "30ms"))
    at = f"{rng.randint(60, 300)}ms"
    world.job["faults"] = [{"restart": again.full_name, "at": at, "for": pause}]
    return _value(rng, node, 6)


@fault("node that starts late, and later in the other run")
def even_later(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    b = a.copy()
    for world, delay in ((a, "60ms"), (b, "130ms")):
        world.entry(node.name)["start_after"] = {"delay": delay}
    return Planted(
        a, b, Truth(first=(r"start_after.* 60 ms → 130 ms",), never=NEVER, independent=None)
    )


@fault("node that starts again, and later in the other run")
def restarts_later(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source", "relay")
    b = a.copy()
    for world, at in ((a, "100ms"), (b, "180ms")):
        world.job["faults"] = [{"restart": node.full_name, "at": at}]
    return Planted(a, b, Truth(first=(r"faults|restart",), never=NEVER, independent=None))
