"""What nodes take from outside: environment, files, clocks, chance, the order of sets."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace

from campaigns.truth.faults.planting import ALWAYS_FALSE, Planted, Truth, fault, in_hiding, one_of
from campaigns.truth.graph import NodePlan, World, random_world

OUTPUT = ("same-input-different-output",)


def _reads(rng: random.Random, line: str, *, in_constructor: bool) -> tuple[World, NodePlan]:
    """Return a world in which a node adds what it reads to what it publishes."""
    a = random_world(rng)
    node = one_of(rng, a, "source")
    lines = node.callbacks[0].lines
    if in_constructor:
        node.setup.append(f"self.read = {line}")
        lines.insert(1, "value = value + self.read")
    else:
        lines.insert(1, f"value = value + {line}")
    return a, node


def _truth(node: NodePlan, *says: str) -> Truth:
    return Truth(
        OUTPUT,
        node.full_name,
        node.callbacks[0].entity,
        says=says,
        values=node.callbacks[0].publishes,
    )


for _where in (True, False):
    _suffix = "in the constructor" if _where else "in a callback"

    @fault(f"environment variable {_suffix}")
    def environment(rng: random.Random, where: bool = _where) -> Planted:
        line = 'float(os.environ.get("TRUTH_VALUE", "1"))'
        a, node = _reads(rng, line, in_constructor=where)
        a.environment["TRUTH_VALUE"] = "4"
        b = a.copy()
        b.environment["TRUTH_VALUE"] = str(rng.randint(5, 9))
        value = b.environment["TRUTH_VALUE"]
        return Planted(a, b, _truth(node, "TRUTH_VALUE", rf"4'? in a.* '?{value}'? in b"))

    @fault(f"file content {_suffix}")
    def file(rng: random.Random, where: bool = _where) -> Planted:
        line = 'float(pathlib.Path(__file__).with_name("truth.txt").read_text())'
        a, node = _reads(rng, line, in_constructor=where)
        a.files["truth.txt"] = "1.5\n"
        b = a.copy()
        b.files["truth.txt"] = "2.5\n"
        return Planted(a, b, _truth(node, r"truth\.txt"))


@fault("wall clock")
def wall_clock(rng: random.Random) -> Planted:
    a, node = _reads(rng, "time.time()", in_constructor=False)
    a.job["guard"] = {"clock": "warn"}
    return Planted(a, a.copy(), _truth(node, r"time\.time"))


@fault("unseeded random")
def unseeded(rng: random.Random) -> Planted:
    a, node = _reads(rng, "random.random()", in_constructor=False)
    a.job["guard"] = {"random": "warn"}
    return Planted(a, a.copy(), _truth(node, r"random\.random"))


@fault("guard switched off")
def guard_off(rng: random.Random) -> Planted:
    a, node = _reads(rng, "random.random()", in_constructor=False)
    a.job["guard"] = False
    call = r"random\.random\(\) at truth_\w+\.py:\d+"
    truth = _truth(node, rf"possible cause: {call}, which guard: false lets", rf"cause is {call}")
    return Planted(a, a.copy(), truth)


@fault("random drawn once more")
def once_more(rng: random.Random) -> Planted:
    a, node = _reads(rng, "random.random()", in_constructor=False)
    at = rng.randint(2, 5)
    b = in_hiding(a, node.name, ["random.random()"], mark="# after", at=at)
    return Planted(a, b, _truth(node, r"not deterministic|state"))


@fault("process id")
def process(rng: random.Random) -> Planted:
    a, node = _reads(rng, "hidden_number()", in_constructor=False)
    b = a.copy()
    b.hidden = "7"
    for world in (a, b):
        world.node(node.name).setup.append("global hidden_number")
        world.node(node.name).setup.append("hidden_number = lambda: float(hidden() or 3)")
    return Planted(a, b, _truth(node, r"not deterministic"))


Make = Callable[[random.Random], Planted]


@fault("the same file in two folders")
def two_folders(rng: random.Random) -> Planted:
    line = 'float(pathlib.Path(__file__).with_name("truth.txt").read_text())'
    a, node = _reads(rng, line, in_constructor=False)
    a.files["truth.txt"] = "1.5\n"
    b = in_hiding(a, node.name, ["value = value + 1.0"], at=rng.randint(2, 5))
    b.folder = "elsewhere"
    truth = _truth(node, r"not deterministic")
    never = (*ALWAYS_FALSE, r"different answers", r"truth\.txt.*(only|not called)")
    return Planted(a, b, replace(truth, never=never))
