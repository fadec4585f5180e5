"""Runs that end earlier than others, and why."""

from __future__ import annotations

import random

from campaigns.truth.faults.planting import (
    ALWAYS_FALSE,
    NOT_DETERMINISTIC,
    Planted,
    Truth,
    fault,
    in_hiding,
    one_of,
)
from campaigns.truth.faults.settings import NEVER, changed
from campaigns.truth.graph import random_world


@fault("ends earlier: duration")
def duration(rng: random.Random) -> Planted:
    a = random_world(rng)
    b = changed(a, "stop", {"duration": "250ms"})
    truth = Truth(("ended-early",), says=(r"stop\.duration", r"250 ms"), never=NEVER)
    return Planted(a, b, truth)


@fault("ends later: duration")
def longer(rng: random.Random) -> Planted:
    a = random_world(rng)
    b = changed(a, "stop", {"duration": "800ms"})
    truth = Truth(("ran-longer",), says=(r"stop\.duration", r"800 ms"), never=NEVER)
    return Planted(a, b, truth)


@fault("ends earlier: events")
def events(rng: random.Random) -> Planted:
    a = random_world(rng)
    b = changed(a, "stop", {**a.job["stop"], "events": 30})
    return Planted(a, b, Truth(("ended-early",), says=(r"stop\.events", r"30"), never=NEVER))


@fault("exception in a constructor")
def constructor(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source", "relay", "sink")
    b = a.copy()
    b.node(node.name).setup.append('raise RuntimeError("planted")')
    truth = Truth(
        ("exception",),
        first=(r"raised an exception only in b: RuntimeError: planted", node.full_name),
        never=NEVER,
    )
    return Planted(a, b, truth)


@fault("deadlock: a call that waits for its own executor")
def deadlock(rng: random.Random) -> Planted:
    a = random_world(rng, service=True)
    a.node("relay0").setup.append('self.other = self.create_client(Trigger, "/ask")')
    at = rng.randint(2, 5)
    b = in_hiding(a, "relay0", ["self.other.call(Trigger.Request())"], mark="# after", at=at)
    for world in (a, b):
        world.job["executors"] = "single_threaded"
    truth = Truth(
        ("ended-early", "same-input-different-output", "missing"),
        says=(r"wait|deadlock", r"/ask"),
        independent=None,
    )
    return Planted(a, b, truth)


@fault("deadlock: executors")
def deadlock_by_executors(rng: random.Random) -> Planted:
    a = random_world(rng, service=True)
    relay = a.node("relay0")
    relay.setup.append('self.other = self.create_client(Trigger, "/ask")')
    lines = relay.callbacks[0].lines
    at = rng.randint(2, 5)
    lines.append(f"if self.n == {at}:")
    lines.append("    self.other.call(Trigger.Request())")
    a.job["executors"] = "per_node"
    b = changed(a, "executors", "single_threaded")
    stuck = (r"(got stuck at .*|/relay0: .*)waits for the response",)
    truth = Truth(first=stuck, says=(r"executors",), never=ALWAYS_FALSE, independent=None)
    return Planted(a, b, truth)


@fault("exception after which the run goes on")
def logged(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    a.entry(node.name)["on_exception"] = "log"
    b = in_hiding(a, node.name, ['raise ValueError("planted")'], at=rng.randint(2, 6))
    truth = Truth(
        ("exception",),
        node.full_name,
        node.callbacks[0].entity,
        first=(r"raised an exception only in b: ValueError: planted",),
        says=(NOT_DETERMINISTIC,),
    )
    return Planted(a, b, truth)
