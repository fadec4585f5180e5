"""Random graphs of nodes, as source code, job and bag: what faults are planted into.

A node is a module of its own with one class. Its callbacks count how often they ran (``self.n``),
so that a fault can happen at one of their calls. What a fault inserts goes where marks are.
"""

from __future__ import annotations

import copy
import json
import random
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

MS = 1_000_000
HIDDEN = "truth_hidden"
"""The attribute of ``builtins`` that a hidden fault reads: no guard sees it, and no trace tells."""

HEADER = """\
import builtins
import math
import os
import pathlib
import random
import time

import rclpy
from rclpy.node import Node
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import (
    Bool, Float32, Float64, Float64MultiArray, Int64, String, UInt8MultiArray
)
from std_srvs.srv import SetBool, Trigger


def hidden():
    return getattr(builtins, "truth_hidden", "")


"""


@dataclass
class Callback:
    """A callback of a node: its method, what triggers it, and the lines of its body.

    ``publishes`` is the topic it publishes on each time it runs ("" if none, or not each time).
    ``entity`` is the name by which traces know it.
    """

    method: str
    kind: str
    entity: str
    lines: list[str]
    publishes: str = ""
    period_ms: int = 0
    arguments: str = ""
    """What it is called with, where its kind does not say so: ``future``."""

    waits: bool = False
    """Whether it is a coroutine."""


@dataclass
class NodePlan:
    """A node: name, class, lines of its constructor, callbacks.

    ``bottom`` are lines below its class; with some, its module is a program with a ``main``.
    """

    name: str
    role: str
    setup: list[str]
    callbacks: list[Callback]
    parameters: dict[str, float] = field(default_factory=dict)
    hears: tuple[str, ...] = ()
    top: list[str] = field(default_factory=list)
    """Lines of the module in front of the class."""

    bottom: list[str] = field(default_factory=list)
    base: str = "Node"

    @property
    def module(self) -> str:
        return f"truth_{self.name}"

    @property
    def class_name(self) -> str:
        return self.name.title().replace("_", "")

    @property
    def full_name(self) -> str:
        return f"/{self.name}"

    def source(self) -> str:
        """Return the module."""
        text = (
            HEADER
            + "".join(f"{line}\n" for line in self.top)
            + f"class {self.class_name}({self.base}):\n    def __init__(self):\n"
        )
        body = [f"super().__init__({self.name!r})", "self.n = 0", *self.setup]
        text += "".join(f"        {line}\n" for line in body)
        for callback in self.callbacks:
            arguments = {"timer": "self", "service": "self, request, response"}
            head = arguments.get(callback.kind, "self, message")
            head = f"self, {callback.arguments}" if callback.arguments else head
            define = "async def" if callback.waits else "def"
            text += f"\n    {define} {callback.method}({head}):\n"
            text += "".join(f"        {line}\n" for line in ["self.n += 1", *callback.lines])
        return text + "".join(f"{line}\n" for line in ["", "", *self.bottom] if self.bottom)

    def callback(self, method: str = "") -> Callback:
        """Return the callback of that name, without one the first."""
        found = (callback for callback in self.callbacks if callback.method == method)
        return next(found) if method else self.callbacks[0]


@dataclass
class World:
    """All that one run is made from."""

    nodes: list[NodePlan]
    job: dict[str, Any]
    bag: list[tuple[int, str, float]] = field(default_factory=list)
    bag_options: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    hidden: str = ""
    comment: str = ""
    folder: str = "."
    answer: tuple[int, str] | None = None
    """What a server on a port of this machine answers, while the run goes on."""

    working_folder: str = ""
    """Below its folder, where the run is made."""

    def copy(self) -> World:
        return copy.deepcopy(self)

    def node(self, name: str) -> NodePlan:
        return next(node for node in self.nodes if node.name == name)

    def entry(self, name: str) -> dict[str, Any]:
        """Return the entry of a node in the job."""
        module = self.node(name).module
        return next(e for e in self.job["nodes"] if next(iter(e.values())).startswith(f"{module}:"))

    def add(self, *nodes: NodePlan) -> None:
        """Add nodes at the end of the job."""
        for node in nodes:
            target = f"{node.module}:main" if node.bottom else f"{node.module}:{node.class_name}"
            self.nodes.append(node)
            self.job["nodes"].append({"main" if node.bottom else "node": target})

    def write(self, folder: Path) -> Path:
        """Write modules, bag and job below ``folder``; return the job."""
        folder.mkdir(parents=True, exist_ok=True)
        for node in self.nodes:
            (folder / f"{node.module}.py").write_text(node.source(), encoding="utf-8")
        for name, text in self.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text, encoding="utf-8")
        job = dict(self.job)
        if self.bag:
            write_bag(folder / "bag.mcap", self.bag)
            job["bags"] = [{"path": "bag.mcap", **self.bag_options}]
        path = folder / "job.yaml"
        path.write_text(f"{self.comment}{_yaml(job)}", encoding="utf-8")
        return path


def _yaml(job: dict[str, Any]) -> str:
    return "".join(f"{key}: {json.dumps(value)}\n" for key, value in job.items())


def write_bag(path: Path, messages: list[tuple[int, str, float]]) -> None:
    """Write messages (ns, topic, value) as a recording, with the mcap package alone."""
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="truth")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        channels: dict[str, int] = {}
        for number, (stamp, topic, value) in enumerate(messages):
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = struct.pack("<4sd", b"\0\1\0\0", value)
            writer.add_message(channels[topic], stamp, data, stamp, number)
        writer.finish()


def random_world(rng: random.Random, *, bag: bool = False, service: bool = False) -> World:
    """Return a graph of three to eight nodes that runs for about half a second."""
    nodes = [_source(rng, number) for number in range(rng.randint(1, 3))]
    topics = [node.callbacks[0].publishes for node in nodes]
    messages: list[tuple[int, str, float]] = []
    if bag or rng.random() < 0.2:
        messages = _bag(rng)
        topics.append("/b0")
    if service or rng.random() < 0.4:
        nodes.insert(rng.randint(0, len(nodes)), _server())
        service = True
    for number in range(rng.randint(1, 3)):
        heard = "/b0" if messages and number == 0 else rng.choice(topics)
        node = _relay(rng, number, heard, asks=service and number == 0)
        nodes.append(node)
        topics.append(node.callbacks[0].publishes)
    nodes.append(_sink(rng, topics[-1]))
    job: dict[str, Any] = {
        "nodes": [{"node": f"{node.module}:{node.class_name}"} for node in nodes],
        "stop": {"duration": f"{rng.choice((400, 500, 600))}ms"},
        "seed": rng.randrange(100),
    }
    for node in nodes:
        if node.parameters:
            entry = next(e for e in job["nodes"] if e["node"].startswith(f"{node.module}:"))
            entry["parameters"] = dict(node.parameters)
    if messages:
        job["start"] = 0
    return World(nodes, job, messages)


def _source(rng: random.Random, number: int) -> NodePlan:
    name, topic = f"source{number}", f"/s{number}"
    period = rng.choice((10, 20, 25, 40, 50))
    tick = Callback(
        "tick",
        "timer",
        f"Source{number}.tick",
        [
            'value = self.n * self.get_parameter("gain").value + 0.25',
            "# before",
            "self.out.publish(Float64(data=value))",
            "# after",
        ],
        topic,
        period,
    )
    setup = [
        'self.declare_parameter("gain", 1.0)',
        f'self.out = self.create_publisher(Float64, "{topic}", 10)',
        f"self.timer = self.create_timer({period / 1000}, self.tick)",
    ]
    gain = rng.choice((0.5, 1.5, 2.0, 3.25))
    return NodePlan(name, "source", setup, [tick], {"gain": gain})


def _relay(rng: random.Random, number: int, heard: str, *, asks: bool) -> NodePlan:
    name, topic = f"relay{number}", f"/r{number}"
    weight = rng.choice((0.25, 0.5, 0.75))
    lines = [
        f"self.value = self.value * {weight} + message.data",
        "value = self.value",
        "# before",
        "self.out.publish(Float64(data=value))",
        "# after",
    ]
    setup = [
        "self.value = 0.0",
        f'self.out = self.create_publisher(Float64, "{topic}", 10)',
        f'self.subscription = self.create_subscription(Float64, "{heard}", self.heard, 10)',
    ]
    callbacks = [Callback("heard", "subscription", heard, lines, topic)]
    if asks:
        setup.append('self.client = self.create_client(Trigger, "/ask")')
        lines.append("if self.n % 3 == 0:")
        lines.append("    self.client.call_async(Trigger.Request())")
    return NodePlan(name, "relay", setup, callbacks, hears=(heard,))


def _server() -> NodePlan:
    lines = [
        "# before",
        "response.success = True",
        "response.message = str(self.n)",
        "# after",
        "return response",
    ]
    setup = ['self.service = self.create_service(Trigger, "/ask", self.answer)']
    return NodePlan("server", "server", setup, [Callback("answer", "service", "/ask", lines)])


def _sink(rng: random.Random, heard: str) -> NodePlan:
    lines = [
        "# before",
        "self.last = message.data",
        f"if self.n % {rng.choice((2, 3, 5))} == 0:",
        '    self.get_logger().info(f"heard {message.data}")',
        "# after",
    ]
    setup = [
        "self.last = 0.0",
        f'self.subscription = self.create_subscription(Float64, "{heard}", self.heard, 10)',
    ]
    return NodePlan("sink", "sink", setup, [Callback("heard", "subscription", heard, lines)])


def _bag(rng: random.Random) -> list[tuple[int, str, float]]:
    period = rng.choice((15, 30, 45))
    return [(n * period * MS, "/b0", n * 0.5) for n in range(1, 8 + rng.randint(0, 6))]
