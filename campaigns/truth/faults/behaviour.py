"""Callbacks that do something else: once in their code, once for reasons that no trace tells."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from campaigns.truth.faults.planting import (
    NOT_DETERMINISTIC,
    STATE_HINT,
    Planted,
    Truth,
    add,
    in_code,
    in_hiding,
    module_of,
    one_of,
)
from campaigns.truth.graph import NodePlan, World, random_world

OUTPUT = ("same-input-different-output",)


@dataclass(frozen=True)
class Change:
    """What a callback does otherwise, at its call ``at``, and what is true of it."""

    node: NodePlan
    lines: list[str]
    truth: Truth
    mark: str = "# before"
    at: int | str | None = None
    method: str = ""
    """The callback that does it, "" for the first of its node."""

    @property
    def where(self) -> dict[str, Any]:
        """Where its lines go."""
        return {"mark": self.mark, "at": self.at, "method": self.method}


Behaviour = Callable[[random.Random, World], Change]


def behaviour(name: str, **kinds: bool) -> Callable[[Behaviour], Behaviour]:
    """Register two classes of faults: in the code of a node, and hidden."""

    def register(make: Behaviour) -> Behaviour:
        def code(rng: random.Random) -> Planted:
            a = random_world(rng, **kinds)
            change = make(rng, a)
            b = in_code(a, change.node.name, change.lines, **change.where)
            truth = change.truth
            says = (*truth.says, rf"code of module {module_of(change.node)}")
            return Planted(a, b, replace(truth, says=says, never=(*truth.never, NOT_DETERMINISTIC)))

        def hidden(rng: random.Random) -> Planted:
            a = random_world(rng, **kinds)
            change = make(rng, a)
            b = in_hiding(a, change.node.name, change.lines, **change.where)
            truth = change.truth
            says = (*truth.says, NOT_DETERMINISTIC)
            if truth.verdicts == OUTPUT and "guard" not in a.job:
                says = (*says, STATE_HINT)
            return Planted(a, b, replace(truth, says=says))

        add(f"{name}, in code", code, make)
        add(f"{name}, hidden", hidden, make)
        return make

    return register


def truth_of(node: NodePlan, **more: object) -> Truth:
    """Return what is true of a callback that got the same and did something else."""
    base = Truth(OUTPUT, node.full_name, node.callbacks[0].entity)
    return replace(base, **more)  # type: ignore[arg-type]


@behaviour("value")
def value(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    delta = rng.choice((1e-9, 0.125, -3.0, 1e6))
    topic = node.callbacks[0].publishes
    truth = truth_of(node, first=(topic,), values=node.callbacks[0].publishes)
    return Change(node, [f"value = value + {delta!r}"], truth, at=rng.randint(1, 6))


@behaviour("not published")
def not_published(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    truth = truth_of(node, first=(rf"{node.callbacks[0].publishes}\b.* (only in a|not in b)",))
    return Change(node, ["return"], truth, at=rng.randint(2, 6))


@behaviour("published twice")
def published_twice(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    truth = truth_of(node, first=(rf"{node.callbacks[0].publishes} twice in b",))
    return Change(
        node, ["self.out.publish(Float64(data=value))"], truth, "# after", rng.randint(1, 6)
    )


@behaviour("published a call later")
def published_a_call_later(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    at = rng.randint(2, 5)
    lines = [
        f"if self.n == {at}:",
        "    self.late = value",
        "    return",
        f"if self.n == {at + 1}:",
        "    self.out.publish(Float64(data=self.late))",
    ]
    topic, period = node.callbacks[0].publishes, node.callbacks[0].period_ms
    return Change(node, lines, truth_of(node, first=(rf"{topic}\b.* {period} ms later in b",)))


@behaviour("slept")
def slept(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    ms = rng.choice((1, 3, 7))
    topic = node.callbacks[0].publishes
    truth = truth_of(
        node,
        verdicts=("same-input-different-output", "timing"),
        first=(rf"{topic}\b.* {ms} ms later in b",),
    )
    return Change(node, [f"time.sleep({ms / 1000})"], truth, at=rng.randint(2, 6))


@behaviour("order of two publishes")
def order(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    node.setup.append('self.more = self.create_publisher(Float64, "/more", 10)')
    at = rng.randint(1, 6)
    publish = node.callbacks[0].lines.index("self.out.publish(Float64(data=value))")
    node.callbacks[0].lines[publish : publish + 1] = [
        "senders = [self.out, self.more]",
        "# before",
        "for sender in senders:",
        "    sender.publish(Float64(data=value))",
    ]
    node.callbacks[0].lines.remove("# before")
    topic = node.callbacks[0].publishes
    truth = truth_of(
        node,
        first=("in a different order", topic, "/more"),
        never=(*Truth().never, r"only in [ab]"),
    )
    return Change(node, ["senders.reverse()"], truth, at=at)


@behaviour("exception")
def exception(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay", "sink")
    truth = truth_of(
        node,
        verdicts=("exception",),
        first=("raised an exception only in b: RuntimeError: planted",),
        never=(*Truth().never, "happened only"),
    )
    return Change(node, ['raise RuntimeError("planted")'], truth, at=rng.randint(1, 6))


@behaviour("exit")
def exits(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    truth = Truth(("ended-early", *OUTPUT, "exception"), says=(r"(raised|exit)",))
    return Change(node, ["raise SystemExit(3)"], truth, at=rng.randint(2, 6))


@behaviour("shutdown")
def shutdown(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    # what the callback publishes after it is refused, as rcl refuses it
    truth = truth_of(node, verdicts=("exception",), first=(r"raised .*shutting down its context",))
    return Change(node, ["rclpy.shutdown()"], truth, at=rng.randint(2, 6))


@behaviour("log text")
def log(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay", "sink")
    truth = truth_of(node, first=(r"log",), shows=("planted text",))
    return Change(node, ['self.get_logger().warning("planted text")'], truth, at=rng.randint(1, 6))


@behaviour("state only")
def state(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    world.job["guard"] = {"state": "record"}
    world.node(node.name).setup.append("self.planted = 0.0")
    truth = truth_of(node, first=(r"state", r"planted"), shows=(r"planted",))
    return Change(node, ["self.planted = 1.5"], truth, at=rng.randint(1, 6))


@behaviour("state, shown later")
def state_later(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "relay")
    at = rng.randint(1, 4)
    world.node(node.name).setup.append("self.planted = 0.0")
    body = world.node(node.name).callbacks[0]
    body.lines.insert(body.lines.index("# before") + 1, f"if self.n == {at + 2}:")
    body.lines.insert(body.lines.index("# before") + 2, "    value = value + self.planted")
    truth = truth_of(node, first=(node.callbacks[0].publishes,), values=node.callbacks[0].publishes)
    return Change(node, ["self.planted = 2.5"], truth, at=at)


@behaviour("cancelled timer")
def cancelled(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    truth = truth_of(node, first=(r"cancel",))
    return Change(node, ["self.timer.cancel()"], truth, at=rng.randint(1, 6))


@behaviour("changed period")
def changed_period(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    period = node.callbacks[0].period_ms + rng.choice((-3, 2, 7))
    truth = truth_of(node, first=(rf"period.*{node.callbacks[0].period_ms} → {period} ms",))
    lines = [f"self.timer.timer_period_ns = {period} * 1_000_000"]
    return Change(node, lines, truth, at=rng.randint(1, 6))


@behaviour("subscription gone")
def subscription_gone(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "relay")
    truth = Truth(
        (*OUTPUT, "missing"),
        says=(r"subscription", rf"{node.hears[0]}\b"),
        independent=None,
    )
    lines = ["self.destroy_subscription(self.subscription)"]
    return Change(node, lines, truth, "# after", rng.randint(2, 6))


@behaviour("response", service=True)
def response(rng: random.Random, world: World) -> Change:
    node = world.node("server")
    truth = truth_of(node, first=(r"/ask", r"message"))
    return Change(node, ['response.message = "planted"'], truth, "# after", rng.randint(1, 2))


@behaviour("array order")
def array_order(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    node.setup.append('self.list = self.create_publisher(Float64MultiArray, "/list", 10)')
    lines = node.callbacks[0].lines
    lines[lines.index("# before") + 1 : lines.index("# before") + 1] = [
        "self.list.publish(Float64MultiArray(data=items))"
    ]
    lines.insert(lines.index("# before"), "items = [self.n * 1.0, 2.5, 3.5, 0.5]")
    truth = truth_of(node, first=(r"/list", r"different order"))
    return Change(node, ["items.reverse()"], truth, at=rng.randint(1, 6))


@behaviour("parameter set")
def parameter_set(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    lines = ['self.set_parameters([rclpy.Parameter("gain", value=9.5)])']
    truth = truth_of(node, first=(r"gain",))
    return Change(node, lines, truth, "# after", rng.randint(1, 6))


@behaviour("another call of a service", service=True)
def another_call(rng: random.Random, world: World) -> Change:
    node = world.node("relay0")
    truth = truth_of(node, first=(r"call /ask\b.* only in b",))
    lines = ["self.client.call_async(Trigger.Request())"]
    return Change(node, lines, truth, "# before", rng.choice((1, 2, 4, 5)))
