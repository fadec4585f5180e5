"""Changes that do nothing, alone and beside a fault that they must not be blamed for."""

from __future__ import annotations

import random
from collections.abc import Callable

from campaigns.truth.faults.planting import (
    ALWAYS_FALSE,
    NOT_DETERMINISTIC,
    Planted,
    Truth,
    add,
    in_hiding,
    one_of,
)
from campaigns.truth.graph import World, random_world

Change = Callable[[random.Random, World], str]
"""Changes b so that it does the same; returns what must not be blamed."""


def irrelevant(name: str) -> Callable[[Change], Change]:
    """Register two classes: the change alone, and beside a hidden fault."""

    def register(change: Change) -> Change:
        def alone(rng: random.Random) -> Planted:
            a = random_world(rng)
            b = a.copy()
            change(rng, b)
            return Planted(a, b, Truth(("identical",), equal=True, never=(), exit_code=0))

        def beside(rng: random.Random) -> Planted:
            a = random_world(rng)
            node = one_of(rng, a, "source", "relay")
            b = in_hiding(a, node.name, ["value = value + 1.0"], at=rng.randint(1, 4))
            blamed = change(rng, b)
            truth = Truth(
                ("same-input-different-output",),
                node.full_name,
                node.callbacks[0].entity,
                says=(NOT_DETERMINISTIC,),
                never=(*ALWAYS_FALSE, blamed, r"had different settings"),
                values=node.callbacks[0].publishes,
            )
            return Planted(a, b, truth)

        add(f"no effect: {name}", alone, change)
        add(f"fault beside {name}", beside, change)
        return change

    return register


@irrelevant("what is recorded")
def record(rng: random.Random, b: World) -> str:
    b.job["record"] = {"exclude": ["/parameter_events"]}
    return r"record\."


@irrelevant("livelock limit")
def livelock(rng: random.Random, b: World) -> str:
    b.job["livelock_limit"] = rng.randint(5000, 50_000)
    return r"livelock_limit"


@irrelevant("stop conditions that hold later")
def stop(rng: random.Random, b: World) -> str:
    b.job["stop"] = {**b.job["stop"], "events": 99_999}
    return r"stop\."


@irrelevant("comments in the job")
def comment(rng: random.Random, b: World) -> str:
    b.comment = "# the same job, explained\n"
    return r"job\.yaml:"


@irrelevant("layout of the job")
def layout(rng: random.Random, b: World) -> str:
    b.job = dict(reversed(b.job.items()))
    return r"job\.yaml:"


@irrelevant("comments in code")
def code_comment(rng: random.Random, b: World) -> str:
    node = rng.choice(b.nodes)
    node.setup.append("# which changes nothing")
    return r"code of module"


@irrelevant("a parameter that nobody declares")
def parameter(rng: random.Random, b: World) -> str:
    b.entry(rng.choice(b.nodes).name).setdefault("parameters", {})["nobody_declares"] = 3
    return r"nobody_declares"


@irrelevant("a rule for a topic that is not there")
def rule(rng: random.Random, b: World) -> str:
    b.job["delay"] = {"topics": {"/not_there": "5ms"}}
    return r"not_there|delay"


@irrelevant("the seed where nothing draws")
def seed(rng: random.Random, b: World) -> str:
    b.job["seed"] += 1
    return r"\bseed\b"


@irrelevant("code of a node that is not concerned")
def module(rng: random.Random, b: World) -> str:
    b.node("sink").setup.append("self.planted = 1")
    return r"truth_sink"
