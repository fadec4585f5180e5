"""One fault in a graph that has a bit of everything."""

from __future__ import annotations

import random

from campaigns.truth import features
from campaigns.truth.faults.behaviour import OUTPUT, Change, behaviour
from campaigns.truth.faults.planting import Truth
from campaigns.truth.graph import NodePlan, World

FEATURES = (
    features.chain,
    features.choir,
    features.calls,
    features.tuner,
    features.pairs,
    features.latched,
    features.radio,
)
EXECUTORS = ("single_threaded", "per_node", [{"nodes": ["*"], "workers": 3}])


def enrich(rng: random.Random, world: World) -> list[NodePlan]:
    """Add some features and rules; return nodes that publish a ``value`` whenever they run."""
    for feature in rng.sample(FEATURES, rng.randint(2, 4)):
        feature(rng, world)
    if rng.random() < 0.5:
        world.job["executors"] = rng.choice(EXECUTORS)
    if rng.random() < 0.3:
        world.job["execution"] = {"default": rng.choice(("100us", "500us"))}
    if rng.random() < 0.3:
        world.job.setdefault("delay", {})["default"] = rng.choice(("200us", "3ms"))
    return [
        node
        for node in world.nodes
        if "value" in " ".join(node.callbacks[0].lines) and node.callbacks[0].publishes
    ]


def _mixed(
    name: str,
    lines: list[str],
    *first: str,
    mark: str = "# before",
    verdicts: tuple[str, ...] = OUTPUT,
    values: bool = False,
    independent: int | None = 1,
) -> None:
    """Register two classes: a node of a graph with a bit of everything does something else."""

    def make(rng: random.Random, world: World) -> Change:
        node = rng.choice(enrich(rng, world))
        callback = node.callbacks[0]
        texts = tuple(text.format(topic=callback.publishes) for text in first)
        truth = Truth(
            verdicts,
            node.full_name,
            callback.entity,
            first=texts,
            values=callback.publishes if values else "",
            independent=independent,
        )
        at: int | str = rng.randint(1, 3)
        if callback.kind == "plain":  # what calls it counts, too
            at = f"self.n >= {at}"
        return Change(node, lines, truth, mark, at)

    behaviour(f"mixed: {name}", bag=True)(make)


_mixed("value", ["value = value + 0.125"], "{topic}", verdicts=(), values=True)
_mixed("left out", ["return"], r"{topic}\b.* (only in a|not in b)", verdicts=())
_mixed(
    "published twice",
    ["self.out.publish(Float64(data=value))"],
    "{topic} twice in b",
    mark="# after",
    verdicts=(),
)
_mixed("slept", ["time.sleep(0.003)"], r"{topic}\b.* 3 ms later", verdicts=(*OUTPUT, "timing"))
_mixed("slept after", ["time.sleep(0.002)"], "slept 2 ms in b", mark="# after", verdicts=())
_mixed(
    "exception",
    ['raise RuntimeError("planted")'],
    "raised an exception only in b: RuntimeError: planted",
    verdicts=("exception",),
)
_mixed("log", ['self.get_logger().warning("planted")'], 'log WARN "planted" only in b')
_mixed(
    "new subscription",
    ['self.more = self.create_subscription(Float64, "/s0", lambda message: None, 10)'],
    "/s0 only in b",
)
_mixed("new timer", ["self.more = self.create_timer(0.01, lambda: None)"], "timer")
_mixed(
    "several things at once",
    ["value = -value - 1.0", "self.get_logger().error(str(value))", "time.sleep(0.001)"],
    "{topic}",
    verdicts=(),
)
