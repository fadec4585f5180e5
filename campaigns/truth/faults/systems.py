"""Larger graphs: long chains, many timers at once, calls in callbacks, parameters in flight, ..."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace

from campaigns.truth import features
from campaigns.truth.faults.behaviour import OUTPUT, Change, behaviour
from campaigns.truth.faults.planting import Planted, Truth, fault
from campaigns.truth.faults.settings import NEVER
from campaigns.truth.graph import NodePlan, World, random_world

Chosen = tuple[NodePlan, str]
"""A node that a fault goes into, and which of its methods."""

Choose = Callable[[random.Random, World], Chosen]


def _in(
    name: str,
    choose: Choose,
    lines: list[str],
    *first: str,
    mark: str = "# before",
    verdicts: tuple[str, ...] = OUTPUT,
    calls: tuple[int, int] | None = (2, 4),
    values: bool = False,
    independent: int | None = 1,
    when: str | None = None,
    entity: str | None = None,
) -> None:
    """Register two classes: a callback of a part of a graph does something else.

    ``first`` may have ``{topic}``, the topic that the callback publishes on; with ``values`` the
    first line names the two values.
    """

    def make(rng: random.Random, world: World) -> Change:
        node, method = choose(rng, world)
        callback = node.callback(method)
        truth = Truth(
            verdicts,
            node.full_name,
            callback.entity if entity is None else entity,
            first=tuple(text.format(topic=callback.publishes) for text in first),
            values=callback.publishes if values else "",
            independent=independent,
        )
        at = when if when or calls is None else rng.randint(*calls)
        return Change(node, lines, truth, mark, at, method)

    behaviour(name)(make)


def _link(rng: random.Random, world: World) -> Chosen:
    return rng.choice(features.chain(rng, world)), "heard"


def _voice(rng: random.Random, world: World) -> Chosen:
    return rng.choice(features.choir(rng, world)), "tick"


def _called(number: int, method: str) -> Choose:
    return lambda rng, world: (features.calls(rng, world)[number], method)


def _tuning(number: int, method: str) -> Choose:
    return lambda rng, world: (features.tuner(rng, world)[number], method)


def _pair(number: int, method: str) -> Choose:
    return lambda rng, world: (features.pairs(rng, world)[number], method)


def _kept(number: int, method: str) -> Choose:
    return lambda rng, world: (features.latched(rng, world)[number], method)


def _radio(number: int, method: str) -> Choose:
    return lambda rng, world: (features.radio(rng, world)[number], method)


MORE = ["value = value + 0.125"]
TWICE = ["self.out.publish(Float64(data=value))"]
LATER = (*OUTPUT, "timing")
GONE = r"{topic}\b.* (only in a|not in b)"

_in("chain: value", _link, MORE, "{topic}", values=True)
_in("chain: left out", _link, ["return"], GONE)
_in("chain: slept", _link, ["time.sleep(0.002)"], r"{topic}\b.* 2 ms later", verdicts=LATER)
_in("chain: published twice", _link, TWICE, "{topic} twice in b", mark="# after")
_in("timers at once: value", _voice, MORE, "{topic}", values=True)
_in("timers at once: left out", _voice, ["return"], GONE)
_in("timers at once: slept", _voice, ["time.sleep(0.004)"], "4 ms", verdicts=LATER)
_in("timers at once: cancelled", _voice, ["self.timer.cancel()"], "cancel")
_in("timers at once: reset", _voice, ["time.sleep(0.001)", "self.timer.reset()"], mark="# after")
_in("calls: answer of the last server", _called(0, "answer"), MORE, "/inner")
_in("calls: answer of a server that asks another", _called(1, "answer"), MORE, "/outer")
_in("calls: last server slept", _called(0, "answer"), ["time.sleep(0.003)"], "3 ms", verdicts=LATER)
_in("calls: value of what was told", _called(2, "tick"), MORE, "/told", verdicts=())
_in("calls: not asked", _called(2, "tick"), ["return"], "/outer", mark="# asks")
_in(
    "calls: asked twice",
    _called(2, "tick"),
    ["await self.client.call_async(Trigger.Request())"],
    "/outer",
    mark="# asks",
    verdicts=(),
)
_in(
    "calls: server raises",
    _called(1, "answer"),
    ['raise ValueError("planted")'],
    "raised an exception only in b: ValueError: planted",
    verdicts=("exception",),
    independent=None,
)
_in("parameter in flight: value", _tuning(0, "tick"), MORE, r"value.*→")
_in("parameter in flight: not set", _tuning(0, "tick"), ["return"], "/source0/set_parameters")
_in(
    "parameter in flight: later",
    _tuning(0, "tick"),
    ["time.sleep(0.004)"],
    "4 ms later",
    verdicts=LATER,
)
_in(
    "parameter in flight: refused",
    _tuning(1, "check"),
    ["accepted = False"],
    when="parameters[0].value == 1.0",
)
_in("pairs: stamp", _pair(0, "tick"), ["message.header.stamp.nanosec += 500"], r"/left.*stamp")
_in("pairs: left out", _pair(1, "tick"), ["return"], GONE)
_in(
    "pairs: late",
    _pair(1, "tick"),
    ["time.sleep(0.007)"],
    r"/right\b.* 7 ms later",
    verdicts=LATER,
)
_in("pairs: value", _pair(2, "match"), MORE, "/paired", when="self.n > 9")
_in("latched: value", _kept(0, "tick"), MORE, "{topic}", values=True, calls=(1, 2))
_in("latched: left out", _kept(0, "tick"), ["return"], GONE, calls=(1, 2))
_in(
    "latched: nobody waits",
    _kept(1, "tick"),
    ["qos = 10"],
    r"/kept.* QoS\W.*durability transient_local → volatile",
    verdicts=("missing",),
    calls=None,
    entity="/kept",
)
_in("latched: heard", _kept(1, "heard"), MORE, "{topic}", values=True)
_in("radio: value", _radio(0, "tick"), MORE, "{topic}", values=True)
_in("radio: left out", _radio(0, "tick"), ["return"], GONE, independent=None)
_in(
    "radio: published twice",
    _radio(0, "tick"),
    TWICE,
    "{topic} twice in b",
    mark="# after",
    independent=None,
)
_in("radio: heard", _radio(1, "heard"), MORE, "{topic}", values=True)


def _written(
    name: str, plant: Callable[[random.Random, World], NodePlan], old: str, new: str, *first: str
) -> None:
    """Register a class: a line of a constructor is another one."""

    @fault(name)
    def planter(rng: random.Random) -> Planted:
        a = random_world(rng)
        node = plant(rng, a)
        b = a.copy()
        other = b.node(node.name)
        other.setup = [line.replace(old, new) for line in node.setup]
        assert other.setup != node.setup
        says = (rf"code of module {node.module}",)
        return Planted(a, b, Truth(first=first, says=says, never=NEVER, independent=None))


_written("pairs: slop", lambda r, w: features.pairs(r, w)[2], "5_000_000", "-1", "/paired")
_written(
    "latched: durability of the publisher",
    lambda r, w: features.latched(r, w)[0],
    "TRANSIENT_LOCAL",
    "VOLATILE",
    "/kept",
)
_written(
    "chain: another topic is heard",
    lambda r, w: features.chain(r, w)[3],
    '"/link2"',
    '"/link1"',
    "/link2.*/link1|/link1.*/link2",
)
_written("calls: another service", lambda r, w: features.calls(r, w)[2], "outer", "inner", "/inner")


@fault("radio: seed")
def seed(rng: random.Random) -> Planted:
    a = random_world(rng)
    features.radio(rng, a)
    b = a.copy()
    b.job["seed"] += 1
    says = (r"\bseed\b",)
    never = tuple(text for text in NEVER if "random draws" not in text)
    return Planted(a, b, Truth(("draw",), says=says, never=never, independent=None))


@fault("radio: probability of a loss")
def drop(rng: random.Random) -> Planted:
    a = random_world(rng)
    features.radio(rng, a)
    b = a.copy()
    b.job["delay"]["links"][0]["drop"] = 0.9
    truth = Truth((), says=("drop",), first=("/radio",), independent=None)
    return Planted(a, b, replace(truth, never=(r"different number of times", *NEVER[2:])))
