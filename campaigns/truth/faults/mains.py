"""Programs with a ``main``: threads, executors, locks, what they read and how they end."""

from __future__ import annotations

import random
import re
from typing import Any

from campaigns.truth.faults.behaviour import Change, behaviour
from campaigns.truth.faults.planting import Planted, Truth, fault
from campaigns.truth.faults.settings import NEVER
from campaigns.truth.graph import Callback, NodePlan, World, random_world

ANY: tuple[str, ...] = ()
TOP = [
    "import asyncio",
    "import queue",
    "import sys",
    "import threading",
    "from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup",
    "from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor",
]
PUBLISHES = 'self.out = self.create_publisher(Float64, "/program", 10)'


def program(run: list[str], main: list[str], *, setup: tuple[str, ...] = ()) -> NodePlan:
    """Return a program: a node with a method ``run``, and what its ``main`` does with ``node``."""
    tick = ["value = self.n * 0.5", "# before", "self.out.publish(Float64(data=value))", "# after"]
    body = ["def main():", "    rclpy.init()", "    node = Program()"]
    body += [f"    {line}" for line in main]
    callbacks = [
        Callback("run", "plain", "", run, "/program", arguments="*_"),
        Callback("tick", "timer", "Program.tick", tick, "/program"),
    ]
    return NodePlan("program", "program", [PUBLISHES, *setup], callbacks, top=TOP, bottom=body)


LOOP = [
    "for number in range(1, 12):",
    "    value = number * 0.5",
    "    time.sleep(0.02)",
    "    # before",
    "    self.out.publish(Float64(data=value))",
    "    # after",
    "# end",
]
SPIN = ["rclpy.spin(node)"]
THREAD = ["threading.Thread(target=node.run, daemon=True).start()", *SPIN]
TIMER = "self.timer = self.create_timer(0.03, self.tick)"


def _program(
    name: str,
    main: list[str],
    lines: list[str],
    *first: str,
    run: list[str] = LOOP,
    mark: str = "# before",
    verdicts: tuple[str, ...] = ANY,
    says: tuple[str, ...] = (),
    setup: tuple[str, ...] = (),
    method: str = "run",
    each: bool = False,
) -> None:
    """Register two classes: a program does something else in one of its rounds, or at all."""

    def make(rng: random.Random, world: World) -> Change:
        node = program([*run], main, setup=setup)
        world.add(node)
        truth = Truth(verdicts, first=first, says=says, independent=None)
        at = None if each else f"number == {rng.randint(2, 6)}"
        return Change(node, lines, truth, mark, at, method)

    behaviour(name)(make)


for _what, _main in (("a main", ["node.run()"]), ("a thread", THREAD)):
    _program(f"value in {_what}", _main, ["value += 4.0"], r"/program\W+data \d+\.\d → \d+\.\d")
    _program(f"sleep in {_what}", _main, ["time.sleep(0.003)"], r"3 ms")
    _program(
        f"exception in {_what}",
        _main,
        ['raise RuntimeError("planted")'],
        "RuntimeError: planted",
    )
    _program(f"return in {_what}", _main, ["return"], "/program|ended|returned")
    _program(
        f"published twice in {_what}", _main, ["self.out.publish(Float64(data=0.0))"], "/program"
    )

_program("exit of a main", ["node.run()"], ["sys.exit(4)"], "shutdown", says=(r"exit code 4",))
_program(
    "spin_once left out",
    ["node.run()"],
    ["continue"],
    "main truth_program:main",
    run=["for number in range(1, 12):", "    # before", "    rclpy.spin_once(self)"],
    setup=(TIMER,),
)
_program(
    "time limit of spin_once",
    ["node.run()"],
    ["limit = 0.004"],
    run=[
        "for number in range(1, 40):",
        "    limit = 0.011",
        "    # before",
        "    rclpy.spin_once(self, timeout_sec=limit)",
        "    self.out.publish(Float64(data=float(number)))",
    ],
)
_program(
    "node destroyed and made again",
    ["while rclpy.ok():", "    node.run()", "    node.destroy_node()", "    node = Program()"],
    ["return"],
    run=["for number in range(1, 30):", "    # before", "    rclpy.spin_once(self)"],
    setup=(TIMER,),
)
_program(
    "items of a queue in another order",
    [
        "threading.Thread(target=node.run, daemon=True).start()",
        "while rclpy.ok():",
        "    node.out.publish(Float64(data=node.queue.get()))",
    ],
    ["items.reverse()"],
    "/program",
    run=[
        "for number in range(1, 12):",
        "    time.sleep(0.02)",
        "    items = [number * 1.0, number + 0.5]",
        "    # before",
        "    for item in items: self.queue.put(item)",
    ],
    setup=("self.queue = queue.Queue()",),
)


def _rated(hertz: int) -> NodePlan:
    run = [
        f"rate = self.create_rate({hertz})",
        "for number in range(1, 20):",
        "    rate.sleep()",
        "    # before",
        "    self.out.publish(Float64(data=number * 0.5))",
    ]
    return program(run, THREAD)


@fault("rate object in code")
def rate(rng: random.Random) -> Planted:
    a = random_world(rng)
    a.add(_rated(50))
    b = a.copy()
    run = b.node("program").callback("run")
    run.lines[0] = run.lines[0].replace("50", "40")
    says = (r"code of module truth_program",)
    return Planted(a, b, Truth((), "/program", says=says, never=NEVER, independent=None))


def _executed(main: list[str], group: str) -> NodePlan:
    """Return a program with two timers of which one waits, run by an executor of its own."""
    setup = (
        f"self.group = {group}",
        TIMER.replace("self.tick", "self.tick, callback_group=self.group"),
        "self.other = self.create_timer(0.03, self.run, callback_group=self.group)",
    )
    run = ["time.sleep(0.004)", "self.out.publish(Float64(data=-1.0))"]
    setup = (setup[0], *reversed(setup[1:]))
    return program(run, main, setup=setup)


def _spun(executor: str) -> list[str]:
    return [f"executor = {executor}", "executor.add_node(node)", "executor.spin()"]


def _executors(name: str, one: tuple[str, str], other: tuple[str, str]) -> None:
    """Register a class: another executor, or another group, in the code of a program."""

    @fault(name)
    def planter(rng: random.Random) -> Planted:
        a = random_world(rng)
        b = a.copy()
        for world, (executor, group) in ((a, one), (b, other)):
            world.add(_executed(_spun(executor), group))
        says = (r"code of module truth_program",)
        return Planted(a, b, Truth(says=says, never=NEVER, independent=None))


REENTRANT, EXCLUSIVE = "ReentrantCallbackGroup()", "MutuallyExclusiveCallbackGroup()"
MANY = "MultiThreadedExecutor(num_threads=4)"
_executors("threads of an executor", (MANY, REENTRANT), (MANY.replace("4", "1"), REENTRANT))
_executors("kind of an executor", (MANY, REENTRANT), ("SingleThreadedExecutor()", REENTRANT))
_executors("kind of a callback group", (MANY, REENTRANT), (MANY, EXCLUSIVE))


def _started(name: str, key: str, one: Any, other: Any, read: str, *says: str) -> None:
    """Register a class: a program is started with something else, which it reads."""

    @fault(name)
    def planter(rng: random.Random) -> Planted:
        a = random_world(rng)
        run = [f"offset = float({read})", *LOOP]
        run.insert(run.index("    # before"), "    value += offset")
        a.add(program(run, ["node.run()"]))
        a.entry("program")[key] = one
        b = a.copy()
        b.entry("program")[key] = other
        truth = Truth((), first=says, never=NEVER, independent=None)
        return Planted(a, b, truth)


_started(
    "words of a command line", "arguments", ["10"], ["20"], "sys.argv[1]", "arguments", "10.*20"
)
_started("line that is typed", "stdin", ["10"], ["20"], "input()", "stdin", "10.*20")


@fault("program that starts later")
def starts_later(rng: random.Random) -> Planted:
    a = random_world(rng)
    a.add(program([*LOOP], ["node.run()"]))
    b = a.copy()
    b.entry("program")["start_after"] = {"delay": "50ms"}
    return Planted(a, b, Truth(first=(r"start_after",), never=NEVER, independent=None))


LAUNCH = """<launch>
  <arg name="gain" default="{default}"/>
  <node pkg="truth_launched" exec="talk" name="{name}" namespace="{namespace}">
    <param name="gain" value="{value}"/>
    <remap from="launched" to="{topic}"/>
  </node>
</launch>
"""
USUAL = {
    "default": "1.5",
    "name": "talker",
    "namespace": "",
    "value": "$(var gain)",
    "topic": "heard",
}


def _launched(values: dict[str, str], arguments: dict[str, str]) -> World:
    a = random_world(random.Random(str(values)))
    node = program(
        [
            'gain = self.declare_parameter("gain", 0.0).value',
            'self.out = self.create_publisher(Float64, "launched", 10)',
            *LOOP,
        ],
        ["node.run()"],
    )
    folder = "truth_launched-1.0.dist-info"
    a.files[f"{node.module}.py"] = node.source().replace("value = number", "value = gain + number")
    a.files[f"{folder}/METADATA"] = "Metadata-Version: 2.1\nName: truth_launched\nVersion: 1.0\n"
    a.files[f"{folder}/entry_points.txt"] = f"[console_scripts]\ntalk = {node.module}:main\n"
    a.files["robot.launch.xml"] = LAUNCH.format(**values)
    a.job["launch"] = [{"file": "robot.launch.xml", "arguments": arguments}]
    return a


def _launch(name: str, change: dict[str, str], *says: str, argument: str = "") -> None:
    """Register a class: a launch file, or its argument, is another one."""

    @fault(f"launch file: {name}")
    def planter(rng: random.Random) -> Planted:
        a = _launched(USUAL, {})
        b = _launched(USUAL, {})
        b.files["robot.launch.xml"] = LAUNCH.format(**{**USUAL, **change})
        if argument:
            b.job["launch"][0]["arguments"] = {"gain": argument}
        truth = Truth(says=says, never=NEVER, independent=None)
        return Planted(a, b, truth)


_launch("default of an argument", {"default": "2.5"}, "gain", r"1\.5.*2\.5")
_launch("argument", {}, "gain", r"2\.5", argument="2.5")
_launch("parameter", {"value": "3.5"}, "gain", r"1\.5.*3\.5")
_launch("name of a node", {"name": "speaker"}, re.escape("/talker"), "/speaker")
_launch("namespace", {"namespace": "robot"}, "/robot/talker")
_launch("remapping", {"topic": "elsewhere"}, "/heard", "/elsewhere")
