"""Two faults that have nothing to do with each other: what shows first leads, and is explained."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace

from campaigns.truth.faults.behaviour import truth_of
from campaigns.truth.faults.planting import NOT_DETERMINISTIC, Planted, Truth, fault, insert
from campaigns.truth.faults.settings import _two_sources
from campaigns.truth.graph import NodePlan, World

Second = Callable[[World, World, NodePlan], None]
"""Plants a second fault, in the node source0 or what hears it."""


def _beside(name: str, second: Second, *never: str) -> None:
    """Register two classes: a hidden fault of the twin at once, and something else from its sixth
    call on, which must not be blamed; the twin's reason is in its code, or hidden."""
    for code in (True, False):

        @fault(f"fault in {'code' if code else 'hiding'}, and {name} later")
        def planter(rng: random.Random, code: bool = code) -> Planted:
            a, twin = _two_sources(rng)
            b = a.copy()
            condition = "self.n == 1" if code else 'hidden() == "fault" and self.n == 1'
            for world in (b,) if code else (a, b):
                lines = [f"if {condition}:", "    value = value + 1.0"]
                insert(world.node(twin.name).callbacks[0], "# before", lines)
            b.hidden = "" if code else "fault"
            second(a, b, a.node("source0"))
            says = (r"code of module truth_twin" if code else NOT_DETERMINISTIC,)
            truth = truth_of(a.node("twin"), first=("/twin",), says=says, values="/twin")
            hidden = (NOT_DETERMINISTIC,) if code else ()
            return Planted(
                a, b, replace(truth, never=(*truth.never, *never, *hidden), independent=None)
            )


def _late(world: World, lines: list[str]) -> None:
    guarded = ["if self.n >= 6:", *(f"    {line}" for line in lines)]
    insert(world.node("source0").callbacks[0], "# before", guarded)


def _read(a: World, b: World, node: NodePlan) -> None:
    for world, value in ((a, "4"), (b, "6")):
        _late(world, ['value = float(os.environ["TRUTH_VALUE"])'])
        world.environment["TRUTH_VALUE"] = value


def _file(a: World, b: World, node: NodePlan) -> None:
    for world, value in ((a, "4"), (b, "6")):
        _late(world, ['value = float(pathlib.Path(__file__).with_name("t.txt").read_text())'])
        world.files["t.txt"] = value


def _coded(a: World, b: World, node: NodePlan) -> None:
    _late(b, ["value = -1.0"])


def _slept(a: World, b: World, node: NodePlan) -> None:
    _late(b, ["time.sleep(0.001)"])


def _raised(a: World, b: World, node: NodePlan) -> None:
    _late(b, ['raise RuntimeError("later")'])


def _duration(a: World, b: World, node: NodePlan) -> None:
    b.job["stop"] = {"duration": "300ms"}


def _logged(a: World, b: World, node: NodePlan) -> None:
    _late(b, ['self.get_logger().error("later")'])


_beside("an environment variable", _read, "TRUTH_VALUE")
_beside("a file", _file, r"t\.txt")
_beside("code of another node", _coded, "truth_source0")
_beside("a sleep in another node", _slept, "slept", "truth_source0")
_beside("an exception", _raised, "truth_source0")
_beside("an earlier end", _duration, "stop")
_beside("a log", _logged, "later", "truth_source0")


def _together(name: str, *says: str) -> Callable[[Second], Second]:
    """Register a class: a changed parameter of source0 leads, whatever else differs."""

    def register(second: Second) -> Second:
        @fault(f"parameter, and {name}")
        def planter(rng: random.Random) -> Planted:
            a, _ = _two_sources(rng)
            node = a.node("source0")
            b = a.copy()
            b.entry(node.name)["parameters"]["gain"] = node.parameters["gain"] + 1.0
            second(a, b, node)
            first = (rf"[Pp]arameter gain {node.parameters['gain']} → ",)
            truth = Truth((), node.full_name, first=first, says=says, independent=None)
            return Planted(a, b, truth)

        return second

    return register


@_together("a comment in the job")
def _commented(a: World, b: World, node: NodePlan) -> None:
    b.comment = "# the same\n"


@_together("code of another node")
def _other_code(a: World, b: World, node: NodePlan) -> None:
    b.node("sink").callbacks[0].lines.append("self.more = 1")


@_together("what is recorded")
def _recorded(a: World, b: World, node: NodePlan) -> None:
    b.job["record"] = {"exclude": ["/nothing*"]}


@_together("a variable that nobody reads")
def _variable(a: World, b: World, node: NodePlan) -> None:
    b.environment["TRUTH_UNUSED"] = "5"
