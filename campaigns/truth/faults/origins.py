"""Where the cause lies: in what was read on import, in modules that a node uses, or does not."""

from __future__ import annotations

import random
from dataclasses import replace

from campaigns.truth.faults.outside import _reads, _truth
from campaigns.truth.faults.planting import (
    ALWAYS_FALSE,
    NOT_DETERMINISTIC,
    Planted,
    Truth,
    fault,
    in_hiding,
    one_of,
)
from campaigns.truth.graph import NodePlan, World, random_world

READ = 'float(os.environ.get("TRUTH_VALUE", "1"))'
LIKELY = r"likely cause: "


def _another_environment(a: World, rng: random.Random) -> tuple[World, str]:
    a.environment["TRUTH_VALUE"] = "4"
    b = a.copy()
    b.environment["TRUTH_VALUE"] = value = str(rng.randint(5, 9))
    return b, value


@fault("environment variable on import")
def on_import(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    node.top.append(f"READ = {READ}")
    node.callbacks[0].lines.insert(1, "value = value + READ")
    b, value = _another_environment(a, rng)
    words = rf"{LIKELY}{node.full_name} read TRUTH_VALUE \(4 in a, {value} in b\) at {node.module}"
    return Planted(a, b, replace(_truth(node), first=(words,)))


@fault("environment variable in a helper")
def in_helper(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    a.files["truth_helper.py"] = f"import os\n\nREAD = {READ}\n"
    node.top.append("import truth_helper")
    node.callbacks[0].lines.insert(1, "value = value + truth_helper.READ")
    b, value = _another_environment(a, rng)
    words = rf"{LIKELY}.* read TRUTH_VALUE \(4 in a, {value} in b\) at truth_helper\.py:3"
    return Planted(a, b, replace(_truth(node), first=(words,)))


@fault("environment variable of one run")
def only_one(rng: random.Random) -> Planted:
    a, node = _reads(rng, READ, in_constructor=rng.random() < 0.5)
    b = a.copy()
    b.environment["TRUTH_VALUE"] = "7"
    words = rf"{LIKELY}{node.full_name} read TRUTH_VALUE \(not set in a, 7 in b\)"
    return Planted(a, b, replace(_truth(node), first=(words,)))


@fault("environment variable that shows late")
def shows_late(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    node.setup.append(f"self.read = {READ}")
    node.callbacks[0].lines.insert(1, f"if self.n == {rng.randint(3, 6)}: value = self.read")
    b, value = _another_environment(a, rng)
    words = rf"{LIKELY}{node.full_name} read TRUTH_VALUE \(4 in a, {value} in b\)"
    return Planted(a, b, replace(_truth(node), first=(words,)))


@fault("environment variable that another node reads")
def of_another_node(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    a.node("sink").setup.append(f"self.read = {READ}")
    a.node("sink").top.append(f"READ = {READ}")
    hidden = in_hiding(a, node.name, ["value = value + 1.0"], at=rng.randint(2, 5))
    b, _ = _another_environment(a, rng)
    b.hidden = hidden.hidden
    truth = _truth(node, NOT_DETERMINISTIC)
    return Planted(a, b, replace(truth, never=(*ALWAYS_FALSE, "TRUTH_VALUE", "likely cause")))


@fault("environment variable that agrees beside one that differs")
def beside(rng: random.Random) -> Planted:
    line = f'float(os.environ["TRUTH_SAME"]) + {READ}'
    a, node = _reads(rng, line, in_constructor=False)
    a.environment["TRUTH_SAME"] = "3"
    b, _ = _another_environment(a, rng)
    truth = _truth(node, "TRUTH_VALUE")
    return Planted(a, b, replace(truth, never=(*ALWAYS_FALSE, "TRUTH_SAME")))


@fault("environment variable that decides on a topic")
def decides_on_topic(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    node.setup.append(f"self.unused = {READ}")
    topic = 'os.environ["TRUTH_TOPIC"]'
    node.setup.append(f"self.more = self.create_publisher(Float64, {topic}, 10)")
    b, _ = _another_environment(a, rng)
    a.environment["TRUTH_TOPIC"] = "/one"
    b.environment["TRUTH_TOPIC"] = "/other"
    truth = Truth(
        ("graph",),
        node.full_name,
        first=(rf"{LIKELY}{node.full_name} read TRUTH_TOPIC \(/one in a, /other in b\)",),
        never=(*ALWAYS_FALSE, "TRUTH_VALUE"),
        independent=None,
    )
    return Planted(a, b, truth)


@fault("environment variable that decides on a parameter")
def decides_on_parameter(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    node.setup.append(f'self.more = self.declare_parameter("more", {READ}).value')
    node.callbacks[0].lines.insert(1, "value = value + self.more")
    b, value = _another_environment(a, rng)
    words = rf"{node.full_name} read TRUTH_VALUE \(4 in a, {value} in b\) at .*; first effect: "
    truth = Truth((), node.full_name, first=(words, node.callbacks[0].publishes))
    return Planted(a, b, truth)


@fault("two environment variables that differ")
def both(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source")
    node.setup.append('self.unused = os.environ["TRUTH_UNUSED"]')
    node.setup.append(f"self.read = {READ}")
    node.callbacks[0].lines.insert(1, "value = value + self.read")
    b, value = _another_environment(a, rng)
    a.environment["TRUTH_UNUSED"] = "here"
    b.environment["TRUTH_UNUSED"] = "there"
    truth = _truth(node)
    return Planted(a, b, replace(truth, first=(rf"TRUTH_VALUE \(4 in a, {value} in b\)",)))


@fault("file that is missing")
def missing_file(rng: random.Random) -> Planted:
    path = 'pathlib.Path(__file__).with_name("truth.txt")'
    line = f"(float(len({path}.read_bytes())) if {path}.exists() else 0.0)"
    a, node = _reads(rng, line, in_constructor=False)
    b = a.copy()
    b.files["truth.txt"] = "1.5\n"
    b.folder = "elsewhere"
    return Planted(a, b, _truth(node, r"truth\.txt"))


@fault("directory that has another file")
def directory(rng: random.Random) -> Planted:
    line = 'sum(name.endswith(".txt") for name in os.listdir(os.path.dirname(__file__)))'
    a, node = _reads(rng, line, in_constructor=False)
    a.job["guard"] = {"directory": "warn"}
    b = a.copy()
    b.files["more.txt"] = "more\n"
    b.folder = "elsewhere"
    return Planted(a, b, _truth(node, r"listed"))


@fault("name in a directory that is listed in order")
def name(rng: random.Random) -> Planted:
    line = 'float(len(os.listdir(pathlib.Path(__file__).with_name("things"))))'
    a, node = _reads(rng, line, in_constructor=False)
    a.files["things/one"] = "1\n"
    b = a.copy()
    b.files["things/more"] = "2\n"
    listed = r"listed things \(1 name \(one\) in a, 2 names \(more, one\) in b\) at .*:\d+"
    return Planted(a, b, _truth(node, listed))


@fault("output of a program")
def program(rng: random.Random) -> Planted:
    line = 'float(subprocess.run(["printenv", "TRUTH_VALUE"], capture_output=True).stdout)'
    a, node = _reads(rng, line, in_constructor=False)
    a.job["guard"] = {"process": "record"}
    node.top.append("import subprocess")
    b, _ = _another_environment(a, rng)
    return Planted(a, b, _truth(node, r"subprocess|printenv|Popen"))


@fault("order of a set")
def set_order(rng: random.Random) -> Planted:
    """A set whose order is that of the addresses of its members, which are other ones each time."""
    a = random_world(rng)
    node = one_of(rng, a, "source")
    node.setup += [
        'self.list = self.create_publisher(Float64MultiArray, "/list", 10)',
        "self.things = {Thing(n) for n in range(12)}",
        'if hidden() == "fault": self.things = {Thing(n) for n in reversed(range(12))}',
    ]
    node.top += [
        "class Thing:",
        "    def __init__(self, n): self.n = n",
        '    def __hash__(self): return self.n % 3 + 8 * (hidden() == "fault")',
    ]
    lines = node.callbacks[0].lines
    lines.insert(lines.index("# before"), "items = [float(thing.n) for thing in self.things]")
    lines.insert(lines.index("# before"), "self.list.publish(Float64MultiArray(data=items))")
    a.job["guard"] = {"order": "allow"}
    b = a.copy()
    b.hidden = "fault"
    first = (
        r"/list\W+data has the same elements in a different order",
        rf"{LIKELY}the order of the set self\.things at {node.module}\.py:\d+",
    )
    return Planted(a, b, replace(_truth(node), first=first, values=""))


def _helped(rng: random.Random) -> tuple[World, NodePlan]:
    a = random_world(rng)
    a.files["truth_helper.py"] = "OFFSET = 0.5\n"
    return a, one_of(rng, a, "source")


@fault("code of a helper")
def helper(rng: random.Random) -> Planted:
    a, node = _helped(rng)
    node.top.append("import truth_helper")
    node.callbacks[0].lines.insert(1, "value = value + truth_helper.OFFSET")
    b = a.copy()
    b.files["truth_helper.py"] = "OFFSET = 0.75\n"
    truth = _truth(node, r"code of module truth_helper")
    return Planted(a, b, replace(truth, never=(*ALWAYS_FALSE, NOT_DETERMINISTIC)))


@fault("fault beside code of a helper that another node uses")
def others_helper(rng: random.Random) -> Planted:
    a, node = _helped(rng)
    a.node("sink").top.append("from truth_helper import OFFSET")
    b = in_hiding(a, node.name, ["value = value + 1.0"], at=rng.randint(1, 4))
    b.files["truth_helper.py"] = "OFFSET = 0.75\n"
    truth = _truth(node, NOT_DETERMINISTIC)
    return Planted(a, b, replace(truth, never=(*ALWAYS_FALSE, r"code of module")))


@fault("fault beside comments in its own code")
def own_comments(rng: random.Random) -> Planted:
    a = random_world(rng)
    node = one_of(rng, a, "source", "relay")
    b = in_hiding(a, node.name, ["value = value + 1.0"], at=rng.randint(1, 4))
    b.node(node.name).setup.insert(0, "# which changes nothing")
    b.node(node.name).callbacks[0].lines.insert(0, "# and neither does this")
    truth = _truth(node, NOT_DETERMINISTIC)
    return Planted(a, b, replace(truth, never=(*ALWAYS_FALSE, r"code of module")))


@fault("guard that keeps states in one run only")
def states_of_one(rng: random.Random) -> Planted:
    a = random_world(rng)
    b = a.copy()
    b.job["guard"] = {"state": True}
    never = (*ALWAYS_FALSE, NOT_DETERMINISTIC)
    return Planted(a, b, Truth(says=(r"guard\.state",), never=never, independent=None))


@fault("no effect: what the guard keeps")
def keeps(rng: random.Random) -> Planted:
    a, _ = _reads(rng, READ, in_constructor=True)
    b = a.copy()
    b.job["guard"] = {"environment": "record"}
    return Planted(a, b, Truth(("identical",), equal=True, never=(), exit_code=0))


@fault("no effect: a docstring")
def docstring(rng: random.Random) -> Planted:
    a = random_world(rng)
    b = a.copy()
    b.node("sink").callbacks[0].lines.insert(0, '"""Hear."""')
    return Planted(a, b, Truth(("identical",), equal=True, never=(), exit_code=0))
