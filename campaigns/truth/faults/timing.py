"""Timers, clocks and what waits on them: reset, made in another order, on another clock."""

from __future__ import annotations

import random

from campaigns.truth.faults.behaviour import Change, behaviour
from campaigns.truth.faults.planting import Planted, Truth, fault, one_of
from campaigns.truth.faults.settings import NEVER, changed
from campaigns.truth.graph import World, random_world


def _timed(
    name: str, lines: list[str], *first: str, mark: str = "# after", setup: tuple[str, ...] = ()
) -> None:
    """Register two classes: a source does something to its timer or clock in one of its calls."""

    def make(rng: random.Random, world: World) -> Change:
        node = one_of(rng, world, "source")
        node.setup += setup
        truth = Truth((), node.full_name, first=first, independent=None)
        return Change(node, lines, truth, mark, rng.randint(2, 6))

    behaviour(name)(make)


_timed("timer reset after a sleep", ["time.sleep(0.003)", "self.timer.reset()"], "3 ms")
_timed("timer cancelled and reset", ["self.timer.cancel()", "self.timer.reset()"])
_timed("timer with another callback", ["self.timer.callback = lambda: None"])
_timed("clock that was slept on", ["self.get_clock().sleep_for(Duration(seconds=0.002))"], "2 ms")
_timed(
    "timer that is replaced",
    ["self.destroy_timer(self.timer)", "self.timer = self.create_timer(0.007, self.tick)"],
    "timer",
)
_timed(
    "one-shot timer",
    ["self.once = self.create_timer(0.004, self.shoot)"],
    "timer",
    setup=("self.shoot = lambda: (self.once.cancel(), self.out.publish(Float64(data=-9.0)))",),
)


def _in_setup(name: str, one: str, other: str, *says: str, mark: str = "create_timer") -> None:
    """Register a class: a source makes its timer otherwise, in its code."""

    @fault(name)
    def planter(rng: random.Random) -> Planted:
        a = random_world(rng)
        node = one_of(rng, a, "source")
        b = a.copy()
        for world, text in ((a, one), (b, other)):
            plan = world.node(node.name)
            at = next(i for i, line in enumerate(plan.setup) if mark in line)
            period = node.callbacks[0].period_ms / 1000
            plan.setup[at : at + 1] = text.format(period=period).split("; ")
        says_ = (rf"code of module {node.module}", *says)
        truth = Truth((), node.full_name, says=says_, never=NEVER, independent=None)
        return Planted(a, b, truth)


TIMER = "self.timer = self.create_timer({period}, self.tick)"
MORE = "self.more = self.create_timer({period}, lambda: self.out.publish(Float64(data=-2.0)))"
_in_setup("timer that does not start", TIMER, TIMER.replace("tick)", "tick, autostart=False)"))
_in_setup("timers made in another order", f"{TIMER}; {MORE}", f"{MORE}; {TIMER}")
_in_setup("callback of a timer", TIMER, TIMER.replace("self.tick", "lambda: None"))
_in_setup(
    "timer that is made twice",
    TIMER,
    f"{TIMER}; self.again = self.create_timer({{period}}, self.tick)",
    "timer",
)


def _clocked(name: str, one: object, other: object, line: str) -> None:
    """Register a class: a node asks a clock that the job sets otherwise."""

    @fault(name)
    def planter(rng: random.Random) -> Planted:
        a = random_world(rng)
        node = one_of(rng, a, "source")
        node.callbacks[0].lines.insert(1, line)
        a.job["clocks"] = [{"node": node.full_name, **one}]  # type: ignore[dict-item]
        b = changed(a, "clocks", [{"node": node.full_name, **other}])  # type: ignore[dict-item]
        return Planted(a, b, Truth((), node.full_name, first=("clocks",), never=NEVER))


_clocked(
    "clock of the system that is wrong",
    {"offset": "0ms"},
    {"offset": "-20ms"},
    "value = value + time.time()",
)
_clocked(
    "jump of a clock, one that comes later",
    {"jumps": [{"at": "100ms", "by": "5ms"}]},
    {"jumps": [{"at": "200ms", "by": "5ms"}]},
    "value = value + self.get_clock().now().nanoseconds * 1e-9",
)


@fault("time of the simulation for all nodes")
def use_sim_time(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    a.entry(node.name).setdefault("parameters", {})["use_sim_time"] = False
    b = a.copy()
    b.entry(node.name)["parameters"]["use_sim_time"] = True
    return Planted(
        a, b, Truth((), node.full_name, first=("use_sim_time",), never=NEVER, independent=None)
    )
