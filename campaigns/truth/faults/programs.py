"""Scripts and processes of their own, and jobs that are put together from several files."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from typing import Any

from campaigns.truth import features
from campaigns.truth.faults.mains import LOOP, program
from campaigns.truth.faults.planting import (
    NOT_DETERMINISTIC,
    Planted,
    Truth,
    fault,
    in_code,
    in_hiding,
    one_of,
)
from campaigns.truth.faults.settings import NEVER, changed
from campaigns.truth.graph import NodePlan, World, random_world


def _script(world: World, *, isolated: bool, lines: list[str] | None = None) -> NodePlan:
    """Add a program that is run as a file, in the process of the run or in one of its own."""
    node = program([*(lines or []), *LOOP], ["node.run()"])
    node.bottom += ["", "", 'if __name__ == "__main__":', "    main()"]
    world.add(node)
    entry = world.entry(node.name)
    entry.clear()
    entry.update({"script": f"{node.module}.py", **({"isolated": True} if isolated else {})})
    return node


def _file(
    what: str, name: str, lines: list[str], *first: str, isolated: bool, hidden: bool = False
) -> None:
    """Register a class: a script does something else in one of its rounds."""

    @fault(f"{what}: {name}{', hidden' if hidden else ''}")
    def planter(rng: random.Random) -> Planted:
        a = random_world(rng)
        node = _script(a, isolated=isolated)
        condition = f"number == {rng.randint(2, 6)}"
        plant = in_hiding if hidden else in_code
        b = plant(a, node.name, lines, at=condition, method="run")
        says = (NOT_DETERMINISTIC if hidden else r"truth_program",)
        return Planted(a, b, Truth((), first=first, says=says, independent=None))


for _what, _isolated in (("script", False), ("process of its own", True)):
    _file(_what, "value", ["value += 4.0"], r"/program\W+data \d", isolated=_isolated)
    _file(_what, "sleep", ["time.sleep(0.003)"], "3 ms", isolated=_isolated)
    _file(_what, "left out", ["continue"], "/program", isolated=_isolated)
_file("script", "value", ["value += 4.0"], r"/program\W+data", isolated=False, hidden=True)
_file("script", "sleep", ["time.sleep(0.003)"], "3 ms", isolated=False, hidden=True)
_file("process of its own", "exit", ["import sys; sys.exit(4)"], "program", isolated=True)


@fault("process of its own: environment variable")
def process_environment(rng: random.Random) -> Planted:
    a = random_world(rng)
    line = 'offset = float(os.environ["TRUTH_OFFSET"])'
    node = _script(a, isolated=True, lines=[line])
    lines = node.callback("run").lines
    lines.insert(
        next(n for n, text in enumerate(lines) if "# before" in text), "    value += offset"
    )
    entry = a.job["nodes"][-1]
    entry["environment"] = {"TRUTH_OFFSET": "4"}
    b = a.copy()
    b.job["nodes"][-1]["environment"] = {"TRUTH_OFFSET": "6"}
    return Planted(a, b, Truth((), says=("TRUTH_OFFSET", "4.*6"), never=NEVER, independent=None))


# -- jobs of several files -------------------------------------------------------------------------

Compose = Callable[[World, NodePlan, float], None]


def _composed(name: str, compose: Compose) -> None:
    """Register a class: the gain of a source comes from elsewhere, and is another one there."""

    @fault(f"job: {name}")
    def planter(rng: random.Random) -> Planted:
        a = random_world(rng)
        node = one_of(rng, a, "source")
        b = a.copy()
        for world, gain in ((a, 1.5), (b, 2.75)):
            compose(world, node, gain)
        says = (r"gain", r"1\.5.*2\.75")
        truth = Truth((), node.full_name, says=says, never=NEVER, independent=None)
        return Planted(a, b, truth)


def _vars(world: World, node: NodePlan, gain: float) -> None:
    world.job["vars"] = {"strength": gain}
    world.entry(node.name)["parameters"]["gain"] = "$(var strength)"


def _base(world: World, node: NodePlan, gain: float) -> None:
    entry = {"name": node.name, "node": f"{node.module}:{node.class_name}"}
    base = {"nodes": [{**entry, "parameters": {"gain": gain}}], "stop": world.job.pop("stop")}
    world.files["base.yaml"] = json.dumps(base)
    del world.entry(node.name)["parameters"]
    world.entry(node.name)["name"] = node.name
    world.job["base"] = "base.yaml"


def _include(world: World, node: NodePlan, gain: float) -> None:
    entry = world.entry(node.name)
    world.job["nodes"].remove(entry)
    entry["parameters"]["gain"] = gain
    world.files["more.yaml"] = json.dumps({"nodes": [entry]})
    world.job["include"] = "more.yaml"


def _file(world: World, node: NodePlan, gain: float) -> None:
    del world.entry(node.name)["parameters"]
    world.entry(node.name)["parameter_files"] = ["gain.yaml"]
    text = f"{node.full_name}:\n  ros__parameters:\n    gain: {gain}\n"
    world.files["gain.yaml"] = text


_composed("value of a variable", _vars)
_composed("parameter in the base", _base)
_composed("parameter in a file that is included", _include)
_composed("parameter in a parameter file", _file)


def _ruled(name: str, key: str, one: Any, other: Any, *says: str) -> None:
    """Register a class: timers that are due at once, under another rule."""

    @fault(f"job: {name}")
    def planter(rng: random.Random) -> Planted:
        a = random_world(rng)
        features.choir(rng, a)
        a.job["execution"] = {"default": "200us"}
        a.job["start"] = "10ms"
        a.job[key] = one
        b = changed(a, key, other)
        return Planted(a, b, Truth((), says=says, never=NEVER, independent=None))


def _workers(count: int) -> list[dict[str, Any]]:
    return [{"nodes": ["*"], "workers": count}]


_ruled("workers of an executor", "executors", _workers(1), _workers(3), "executors")
_ruled("nodes of an executor", "executors", _workers(1), "per_node", "executors")
_ruled("policy", "policy", "fifo", "rate_monotonic", "policy")
_ruled("time in which nodes are made", "construct_time", "1ms", "3ms", "construct_time")
