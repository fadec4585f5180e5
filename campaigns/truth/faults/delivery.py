"""Queues and QoS: what was sent and not received."""

from __future__ import annotations

import random
from dataclasses import replace

from campaigns.truth.faults.planting import ALWAYS_FALSE, NOT_DETERMINISTIC, Planted, Truth, fault
from campaigns.truth.graph import Callback, NodePlan, World, random_world

NEVER = (*ALWAYS_FALSE, NOT_DETERMINISTIC)


def _burst(rng: random.Random) -> tuple[World, NodePlan]:
    """Return a world in which one node gets eight messages at once, every 50 ms."""
    a = random_world(rng)
    sender = NodePlan(
        "burst",
        "burst",
        [
            'self.out = self.create_publisher(Float64, "/burst", 20)',
            "self.timer = self.create_timer(0.05, self.tick)",
        ],
        [
            Callback(
                "tick",
                "timer",
                "Burst.tick",
                [
                    "for number in range(8):",
                    "    self.out.publish(Float64(data=self.n * 8.0 + number))",
                ],
                "",
                50,
            )
        ],
    )
    receiver = NodePlan(
        "drain",
        "drain",
        [
            'self.subscription = self.create_subscription(Float64, "/burst", self.heard, 10)',
            'self.out = self.create_publisher(Float64, "/drained", 10)',
        ],
        [
            Callback(
                "heard",
                "subscription",
                "/burst",
                ["self.out.publish(Float64(data=message.data))"],
                "/drained",
            )
        ],
    )
    a.nodes += [sender, receiver]
    a.job["nodes"] += [{"node": f"{n.module}:{n.class_name}"} for n in (sender, receiver)]
    return a, receiver


@fault("queue depth")
def depth(rng: random.Random) -> Planted:
    a, receiver = _burst(rng)
    b = a.copy()
    shallow = rng.randint(1, 5)
    setup = b.node("drain").setup
    setup[0] = setup[0].replace("self.heard, 10", f"self.heard, {shallow}")
    return Planted(
        a,
        b,
        Truth(
            ("missing",),
            receiver.full_name,
            "/burst",
            first=(rf"queue \(depth 10 → {shallow}\) overflowed",),
            says=(rf"code of module {receiver.module}",),
            never=NEVER,
        ),
    )


@fault("queue that overflows because its node is slow")
def slow(rng: random.Random) -> Planted:
    a, receiver = _burst(rng)
    a.job["executors"] = "per_node"
    b = a.copy()
    b.job["execution"] = {"nodes": {receiver.full_name: "12ms"}}
    return Planted(
        a,
        b,
        Truth(("draw", "timing"), receiver.full_name, says=(r"execution",), never=NEVER),
    )


@fault("QoS that does not fit")
def incompatible(rng: random.Random) -> Planted:
    a, _ = _burst(rng)
    b = a.copy()
    setup = b.node("burst").setup
    setup[0] = setup[0].replace(
        ", 20)", ", QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT))"
    )
    return Planted(
        a,
        b,
        Truth(
            ("missing", "graph", "same-input-different-output"),
            first=(
                r"/burst created publisher /burst with a different QoS: reliability reliable → "
                r"best_effort, which in b does not match the subscription of /drain",
            ),
            says=(r"code of module truth_burst",),
            never=NEVER,
            independent=None,
        ),
    )


def _changed_setup(
    name: str, node: str, old: str, new: str, *says: str, same: bool = False
) -> None:
    """Register a class: a line of a constructor of the burst or the drain is another one."""

    @fault(name)
    def planter(rng: random.Random) -> Planted:
        a, _ = _burst(rng)
        b = a.copy()
        setup = b.node(node).setup
        setup[:] = [line.replace(old, new) for line in setup]
        assert setup != a.node(node).setup
        if same:
            return Planted(a, b, Truth(("identical",), equal=True, never=(), exit_code=0))
        says_ = (*says, rf"code of module truth_{node}")
        return Planted(a, b, Truth(says=says_, never=NEVER, independent=None))


SUBSCRIBED = '"/burst", self.heard, 10)'
_changed_setup(
    "QoS: durability that nobody offers",
    "drain",
    SUBSCRIBED,
    '"/burst", self.heard, QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL))',
    r"/drain created subscription /burst with a different QoS: durability volatile → "
    r"transient_local, which in b does not match the publisher of /burst",
)
_changed_setup(
    "QoS: liveliness that nobody offers",
    "drain",
    SUBSCRIBED,
    '"/burst", self.heard, '
    "QoSProfile(depth=10, liveliness=rclpy.qos.LivelinessPolicy.MANUAL_BY_TOPIC))",
    r"QoS: liveliness automatic → manual_by_topic, which in b does not match the publisher of ",
)
_changed_setup(
    "QoS: deadline that is missed",
    "drain",
    SUBSCRIBED,
    '"/burst", self.heard, QoSProfile(depth=10, deadline=Duration(seconds=0.03)))',
    r"QoS: deadline none → 30 ms, which in b does not match the publisher of /burst",
)
_changed_setup(
    "QoS: history",
    "drain",
    SUBSCRIBED,
    '"/burst", self.heard, QoSProfile(depth=3, history=HistoryPolicy.KEEP_LAST))',
    r"queue \(depth 10 → 3\) overflowed",
)
_changed_setup(
    "another type on a topic",
    "burst",
    "Float64, ",
    "Float32, ",
    r"Float64 only in a.*Float32 only in b",
)


def _grouped(name: str, one: str, other: str, *first: str) -> None:
    """Register a class: of two timers at once, of which one sleeps, the other is of ``one``
    callback group in a and of ``other`` in b."""

    @fault(name)
    def planter(rng: random.Random) -> Planted:
        a = random_world(rng)
        slow = Callback("slow", "timer", "Grouped.slow", ["time.sleep(0.01)"], "", 50)
        more = Callback("more", "timer", "Grouped.more", [], "", 50)
        setup = [
            "own, free = MutuallyExclusiveCallbackGroup(), ReentrantCallbackGroup()",
            "self.slow_timer = self.create_timer(0.05, self.slow, callback_group=own)",
            f"self.more_timer = self.create_timer(0.05, self.more, callback_group={one})",
        ]
        top = [
            "from rclpy.callback_groups import MutuallyExclusiveCallbackGroup",
            "from rclpy.callback_groups import ReentrantCallbackGroup",
        ]
        node = NodePlan("grouped", "grouped", setup, [slow, more], top=top)
        a.add(node)
        a.job["executors"] = [{"nodes": [node.full_name], "workers": 2}]
        b = a.copy()
        b.node("grouped").setup[2] = setup[2].replace(f"={one})", f"={other})")
        says = (rf"code of module {node.module}",)
        made = "created timer Grouped.more with a different callback group: (mutually )?"
        truth = Truth(("timing",), node.full_name, "Grouped.more", says=says, never=NEVER)
        return Planted(a, b, replace(truth, first=tuple(made + text for text in first)))


_OTHER = "that of timer Grouped.slow"
_grouped("callback group shared", "None", "own", f"default → mutually exclusive 1, in b {_OTHER}")
_grouped("callback group left", "own", "free", f"exclusive 1 → reentrant 2, in a {_OTHER}")
_changed_setup("relative name", "burst", '"/burst"', '"~/burst"', "/burst/burst")
_changed_setup("depth that is never reached", "drain", ", 10)", ", 12)", same=True)
