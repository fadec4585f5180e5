"""Parts of larger graphs, to be added to a world: chains, choirs, calls, latched topics, ..."""

from __future__ import annotations

import random

from campaigns.truth.graph import Callback, NodePlan, World

GROUPS = "from rclpy.callback_groups import ReentrantCallbackGroup"
BEST_EFFORT = "QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)"
LATCHED = "QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)"
SENDS = ["# before", "self.out.publish(Float64(data=value))", "# after"]


def publisher(topic: str, qos: str = "10") -> str:
    return f'self.out = self.create_publisher(Float64, "{topic}", {qos})'


def hears(topic: str, method: str = "heard", qos: str = "10") -> str:
    return f'self.{method}_on = self.create_subscription(Float64, "{topic}", self.{method}, {qos})'


def timer(period_ms: int, more: str = "") -> str:
    return f"self.timer = self.create_timer({period_ms / 1000}, self.tick{more})"


def ticking(name: str, topic: str, period_ms: int, value: str, qos: str = "10") -> NodePlan:
    """Return a node that publishes a number again and again."""
    lines = [f"value = {value}", *SENDS]
    entity = f"{name.title().replace('_', '')}.tick"
    tick = Callback("tick", "timer", entity, lines, topic, period_ms)
    return NodePlan(name, "source", [publisher(topic, qos), timer(period_ms)], [tick])


def chain(rng: random.Random, world: World) -> list[NodePlan]:
    """Add a long line of nodes, each of which hears the one before it."""
    links = []
    heard = rng.choice([n for n in world.nodes if n.role == "source"]).callbacks[0].publishes
    for number in range(rng.randint(6, 12)):
        topic = f"/link{number}"
        lines = [f"value = message.data + {number}.5", *SENDS]
        callback = Callback("heard", "subscription", heard, lines, topic)
        setup = [publisher(topic), hears(heard, qos=BEST_EFFORT if heard == "/radio" else "10")]
        links.append(NodePlan(f"link{number}", "relay", setup, [callback], hears=(heard,)))
        heard = topic
    world.add(*links)
    return links


def choir(rng: random.Random, world: World) -> list[NodePlan]:
    """Add nodes whose timers are due at one instant, and one that hears them all."""
    period = rng.choice((20, 30))
    voices = [
        ticking(f"voice{n}", f"/voice{n}", period * rng.choice((1, 1, 2)), f"self.n + {n}.25")
        for n in range(rng.randint(3, 5))
    ]
    setup = ["self.value = 0.0", publisher("/choir")]
    callbacks = []
    for number, voice in enumerate(voices):
        topic = voice.callbacks[0].publishes
        setup.append(hears(topic, f"heard{number}"))
        lines = ["self.value = self.value * 0.5 + message.data"]
        callbacks.append(Callback(f"heard{number}", "subscription", topic, lines))
    setup.append(timer(period))
    tick = Callback("tick", "timer", "Leader.tick", ["value = self.value", *SENDS], "/choir")
    world.add(*voices, NodePlan("leader", "leader", setup, [*callbacks, tick]))
    return voices


def calls(rng: random.Random, world: World) -> tuple[NodePlan, NodePlan, NodePlan]:
    """Add a node that awaits a service in a timer, whose server awaits another one."""

    def client(service: str) -> str:
        return (
            f'self.client = self.create_client(Trigger, "{service}", '
            "callback_group=ReentrantCallbackGroup())"
        )

    def server(service: str) -> str:
        return f'self.service = self.create_service(Trigger, "{service}", self.answer)'

    said = ["response.success = True", "response.message = str(value)", "# after"]
    inner = Callback(
        "answer",
        "service",
        "/inner",
        ["value = self.n * 1.0", "# before", *said, "return response"],
    )
    forwarded = [
        "told = await self.client.call_async(Trigger.Request())",
        "value = float(told.message) + 0.5",
        "# before",
        *said,
        "return response",
    ]
    outer = Callback("answer", "service", "/outer", forwarded, waits=True)
    tick = [
        "# asks",
        "told = await self.client.call_async(Trigger.Request())",
        "value = float(told.message)",
        *SENDS,
    ]
    period = rng.choice((30, 45))
    asks = Callback("tick", "timer", "Caller.tick", tick, "/told", period, waits=True)
    nodes = (
        NodePlan("inner", "server", [server("/inner")], [inner]),
        NodePlan("outer", "server", [client("/inner"), server("/outer")], [outer], top=[GROUPS]),
        NodePlan(
            "caller",
            "caller",
            [publisher("/told"), client("/outer"), timer(period)],
            [asks],
            top=[GROUPS],
        ),
    )
    world.add(*rng.sample(nodes, 3))
    return nodes


def tuner(rng: random.Random, world: World) -> tuple[NodePlan, NodePlan]:
    """Add a node that sets a parameter of ``source0`` while that runs; return it and that."""
    source = world.node("source0")
    source.top.append("from rcl_interfaces.msg import SetParametersResult")
    source.setup.append("self.add_on_set_parameters_callback(self.check)")
    checks = ["accepted = True", "# before", "return SetParametersResult(successful=accepted)"]
    source.callbacks.append(Callback("check", "plain", "", checks, arguments="parameters"))
    lines = [
        "value = self.n * 0.5",
        "# before",
        'gain = rclpy.Parameter("gain", value=value).to_parameter_msg()',
        "self.client.call_async(SetParameters.Request(parameters=[gain]))",
        "# after",
    ]
    setup = [
        'self.client = self.create_client(SetParameters, "/source0/set_parameters")',
        timer(rng.choice((45, 70))),
    ]
    top = ["from rcl_interfaces.srv import SetParameters"]
    tick = Callback("tick", "timer", "Tuner.tick", lines)
    node = NodePlan("tuner", "tuner", setup, [tick], top=top)
    world.add(node)
    return node, source


def pairs(rng: random.Random, world: World) -> tuple[NodePlan, NodePlan, NodePlan]:
    """Add two sensors and a node that puts messages of about one stamp together."""
    period = rng.choice((30, 40))
    sensors = []
    for name in ("left", "right"):
        lines = [
            "message = PoseStamped()",
            "message.header.stamp = self.get_clock().now().to_msg()",
            "message.pose.position.x = self.n * 0.5",
            *(line.replace("Float64(data=value)", "message") for line in SENDS),
        ]
        setup = [publisher(f"/{name}").replace("Float64", "PoseStamped"), timer(period)]
        tick = Callback("tick", "timer", f"{name.title()}.tick", lines, f"/{name}", period)
        sensors.append(NodePlan(name, "sensor", setup, [tick]))
    match = [
        "for one in self.left:",
        "    for other in self.right:",
        "        stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec",
        "                  for m in (one, other)]",
        "        if abs(stamps[0] - stamps[1]) <= self.slop:",
        "            self.left.remove(one)",
        "            self.right.remove(other)",
        "            value = one.pose.position.x - other.pose.position.x + self.n",
        *(f"            {line}" for line in SENDS),
        "            return",
    ]
    setup = ["self.left, self.right, self.slop = [], [], 5_000_000", publisher("/paired")]
    callbacks = [Callback("match", "plain", "", match, "/paired", arguments="*_")]
    for name in ("left", "right"):
        setup.append(hears(f"/{name}", f"heard_{name}").replace("Float64", "PoseStamped"))
        lines = [f"self.{name}.append(message)", "self.match()", f"del self.{name}[:-5]"]
        callbacks.append(Callback(f"heard_{name}", "subscription", f"/{name}", lines))
    pairer = NodePlan("pairer", "pairer", setup, callbacks)
    world.add(*sensors, pairer)
    return (*sensors, pairer)


def latched(rng: random.Random, world: World) -> tuple[NodePlan, NodePlan]:
    """Add a node that leaves its last message for others, and one that comes late for it."""
    keeper = ticking("keeper", "/kept", 60, "self.n * 1.5", LATCHED)
    late = NodePlan(
        "late",
        "late",
        [publisher("/late"), timer(rng.choice((100, 150)))],
        [
            Callback(
                "tick",
                "timer",
                "Late.tick",
                [
                    "self.timer.cancel()",
                    f"qos = {LATCHED}",
                    "# before",
                    hears("/kept", qos="qos"),
                    "# after",
                ],
            ),
            Callback("heard", "subscription", "/kept", ["value = message.data", *SENDS], "/late"),
        ],
    )
    world.add(keeper, late)
    return keeper, late


def radio(rng: random.Random, world: World) -> tuple[NodePlan, NodePlan]:
    """Add a sender and a receiver between which messages are lost and late, as chance has it."""
    sender = ticking("sender", "/radio", rng.choice((15, 25)), "self.n * 0.75", BEST_EFFORT)
    heard = Callback(
        "heard", "subscription", "/radio", ["value = message.data + 0.5", *SENDS], "/received"
    )
    setup = [publisher("/received"), hears("/radio", qos=BEST_EFFORT)]
    receiver = NodePlan("receiver", "relay", setup, [heard], hears=("/radio",))
    link = {"topic": "/radio", "drop": 0.3, "uniform": {"min": "1ms", "max": "6ms"}}
    world.job["delay"] = {"links": [link]}
    world.add(sender, receiver)
    return sender, receiver
