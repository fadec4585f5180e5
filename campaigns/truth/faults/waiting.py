"""Callbacks that wait, call, make and destroy things, fail: more of what they can do otherwise."""

from __future__ import annotations

import random

from campaigns.truth.faults.behaviour import OUTPUT, Change, behaviour, truth_of
from campaigns.truth.faults.planting import Truth, one_of
from campaigns.truth.graph import Callback, NodePlan, World


@behaviour("slept longer")
def slept_longer(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    at = rng.randint(1, 6)
    lines = node.callbacks[0].lines
    place = lines.index("# before")
    lines[place : place + 1] = ["nap = 0.002", "# before", f"if self.n == {at}: time.sleep(nap)"]
    truth = truth_of(node, verdicts=("timing",), first=(r"slept .*2 ms in a and 5 ms in b",))
    return Change(node, ["nap = 0.005"], truth, at=at)


@behaviour("slept after it had published")
def slept_after(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    truth = truth_of(node, first=(r"slept 3 ms in b but not in a",))
    return Change(node, ["time.sleep(0.003)"], truth, "# after", rng.randint(1, 6))


@behaviour("server that slept", service=True)
def server_slept(rng: random.Random, world: World) -> Change:
    node = world.node("server")
    truth = truth_of(node, first=(r"slept 4 ms in b but not in a", r"/ask\b.* 4 ms later in b"))
    return Change(node, ["time.sleep(0.004)"], truth, "# before", rng.randint(1, 2))


@behaviour("published three times")
def three_times(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    topic = node.callbacks[0].publishes
    truth = truth_of(node, first=(rf"{topic} 1 times? in a, 3 times in b",))
    lines = ["for _ in range(2): self.out.publish(Float64(data=value))"]
    return Change(node, lines, truth, "# after", rng.randint(1, 6))


@behaviour("new timer")
def new_timer(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    truth = truth_of(node, first=(r"timer",), independent=None)
    lines = ["self.more = self.create_timer(0.033, lambda: None)"]
    return Change(node, lines, truth, at=rng.randint(1, 6))


@behaviour("new publisher")
def new_publisher(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay", "sink")
    truth = truth_of(node, first=(r"/more only in b",))
    lines = ['self.more = self.create_publisher(Float64, "/more", 10)']
    return Change(node, lines, truth, at=rng.randint(1, 6))


@behaviour("destroyed timer")
def destroyed_timer(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    verdicts = (*OUTPUT, "missing", "ended-early")
    truth = Truth(verdicts, node.full_name, says=(r"timer",), independent=None)
    lines = ["self.destroy_timer(self.timer)"]
    return Change(node, lines, truth, "# after", rng.randint(1, 6))


@behaviour("log of another level")
def level(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    lines = node.callbacks[0].lines
    at = lines.index("# before")
    lines[at : at + 1] = [
        "loud = False",
        "# before",
        'if loud: self.get_logger().error("planted text")',
        'else: self.get_logger().info("planted text")',
    ]
    truth = truth_of(node, first=(r"log|rosout",), shows=("planted text|level",))
    return Change(node, ["loud = True"], truth, at=rng.randint(1, 6))


@behaviour("text of a log")
def log_text(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    lines = node.callbacks[0].lines
    at = lines.index("# before")
    lines[at : at + 1] = ['text = "calm"', "# before", "self.get_logger().info(text)"]
    truth = truth_of(node, first=(r'msg "calm" → "planted"',))
    return Change(node, ['text = "planted"'], truth, at=rng.randint(1, 6))


@behaviour("request")
def request(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    _add_switch(world)
    node.setup.append('self.switch = self.create_client(SetBool, "/switch")')
    lines = node.callbacks[0].lines
    at = lines.index("# before")
    lines[at : at + 1] = [
        "wanted = SetBool.Request(data=True)",
        "# before",
        "self.switch.call_async(wanted)",
    ]
    truth = truth_of(node, first=(r"call /switch\b.*data [Tt]rue → [Ff]alse",))
    return Change(node, ["wanted.data = False"], truth, at=rng.randint(1, 6))


def _add_switch(world: World) -> None:
    lines = ["# before", "response.success = request.data", "# after", "return response"]
    setup = ['self.service = self.create_service(SetBool, "/switch", self.answer)']
    node = NodePlan("switch", "server", setup, [Callback("answer", "service", "/switch", lines)])
    world.nodes.append(node)
    world.job["nodes"].append({"node": f"{node.module}:{node.class_name}"})


@behaviour("server that raises", service=True)
def server_raises(rng: random.Random, world: World) -> Change:
    node = world.node("server")
    truth = truth_of(
        node,
        verdicts=("exception",),
        first=("raised an exception only in b: ValueError: planted",),
        independent=None,
    )
    return Change(node, ['raise ValueError("planted")'], truth, at=rng.randint(1, 2))


@behaviour("parameter set to something else")
def other_parameter(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    at = rng.randint(1, 6)
    lines = node.callbacks[0].lines
    place = lines.index("# before")
    lines[place : place + 1] = [
        "gain = 9.5",
        "# before",
        f'if self.n == {at}: self.set_parameters([rclpy.Parameter("gain", value=gain)])',
    ]
    truth = truth_of(node, first=(r"9\.5.*9\.75",), shows=(r"gain|changed_parameters",))
    return Change(node, ["gain = 9.75"], truth, at=at)


@behaviour("another exception")
def another_exception(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay", "sink")
    at = rng.randint(1, 4)
    lines = node.callbacks[0].lines
    place = lines.index("# before")
    lines[place : place + 1] = [
        'text = "one way"',
        "# before",
        f"if self.n == {at}: raise RuntimeError(text)",
    ]
    truth = truth_of(node, verdicts=("exception", *OUTPUT), says=(r"one way.*another way",))
    return Change(node, ['text = "another way"'], truth, at=at)


@behaviour("exception that the node catches")
def caught(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source", "relay")
    topic = node.callbacks[0].publishes
    lines = [
        "try:",
        '    raise RuntimeError("planted")',
        "except RuntimeError:",
        "    value = -1.0",
    ]
    truth = truth_of(node, first=(topic,), values=topic, never=(*Truth().never, "raised"))
    return Change(node, lines, truth, at=rng.randint(1, 6))


@behaviour("time that passed before the node asked")
def asked_late(rng: random.Random, world: World) -> Change:
    node = one_of(rng, world, "source")
    lines = node.callbacks[0].lines
    lines.insert(lines.index("# before"), "value = value + self.now()")
    node.setup.append("self.now = lambda: self.get_clock().now().nanoseconds * 1e-9")
    topic = node.callbacks[0].publishes
    truth = truth_of(node, first=(topic,), values=topic)
    return Change(node, ["value = value + self.now()"], truth, at=rng.randint(1, 6))
