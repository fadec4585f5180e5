"""Answers of the world outside: sockets, programs, files of all kinds, folders."""

from __future__ import annotations

import random
import socket
from dataclasses import replace

from campaigns.truth.faults.origins import LIKELY
from campaigns.truth.faults.outside import _reads, _truth
from campaigns.truth.faults.planting import Planted, Truth, fault
from campaigns.truth.graph import World

LEFT_OPEN = "truth_left_open.txt"
"""A file that a node does not close, as many do; Python warns of it."""


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


ASK = [
    "def ask(port):",
    '    with socket.create_connection(("127.0.0.1", port)) as link:',
    '        link.sendall(b"GET / HTTP/1.0\\r\\n\\r\\n")',
    '        text = b"".join(iter(lambda: link.recv(4096), b""))',
    '    return float(text.rpartition(b"\\r\\n")[2])',
]


def _asked(rng: random.Random, guard: str, line: str) -> tuple[World, World, Truth]:
    port = _free_port()
    a, node = _reads(rng, line.format(port=port), in_constructor=rng.random() < 0.5)
    node.top += ["import socket", "import urllib.request", *ASK]
    a.job["guard"] = {"socket": guard}
    a.answer = (port, "1.5")
    b = a.copy()
    b.answer = (port, "2.5")
    return a, b, _truth(node)


@fault("answer on a socket")
def answer(rng: random.Random) -> Planted:
    a, b, truth = _asked(rng, "record", "ask({port})")
    return Planted(
        a, b, replace(truth, first=(rf"{LIKELY}.*socket\.recv\(\) \(.*1\.5' in a, .*2\.5' in b",))
    )


@fault("answer on a socket that is not recorded")
def unrecorded(rng: random.Random) -> Planted:
    a, b, truth = _asked(rng, "warn", "ask({port})")
    first = (r"possible cause: the result of socket\.connect.* at .*\.py:\d+",)
    return Planted(a, b, replace(truth, first=first, says=(r"not deterministic",)))


@fault("answer over HTTP")
def http(rng: random.Random) -> Planted:
    line = 'float(urllib.request.build_opener().open("http://127.0.0.1:{port}/").read())'
    a, b, truth = _asked(rng, "record", line)
    return Planted(a, b, replace(truth, first=(rf"{LIKELY}.*recv.*1\.5'.* in a, .*2\.5'.* in b",)))


@fault("server that is not there")
def refused(rng: random.Random) -> Planted:
    a, b, truth = _asked(rng, "record", "ask({port})")
    b.answer = None
    says = (r"ConnectionRefusedError|[Cc]onnection refused",)
    return Planted(a, b, Truth((), truth.node, says=says, independent=None))


def _program(name: str, line: str, guard: str, *first: str, **more: object) -> None:
    """Register a class: a node asks a program, whose answer depends on the environment."""

    @fault(name)
    def planter(rng: random.Random) -> Planted:
        a, node = _reads(rng, line, in_constructor=rng.random() < 0.5)
        node.top.append("import subprocess")
        a.job["guard"] = {"process": guard}
        a.environment["TRUTH_VALUE"] = "4"
        b = a.copy()
        b.environment["TRUTH_VALUE"] = "6"
        return Planted(a, b, replace(_truth(node), first=first, **more))  # type: ignore[arg-type]


_program(
    "exit status of a program",
    'float(subprocess.call(["sh", "-c", "exit $TRUTH_VALUE"]))',
    "record",
    rf"{LIKELY}.*Popen\(.*TRUTH_VALUE'\) \(exit status 4 in a, exit status 6 in b\)",
)
_program(
    "output of a shell",
    'float(os.popen("echo $TRUTH_VALUE").read())',
    "record",
    rf"{LIKELY}.*echo \$TRUTH_VALUE'\) \(b'4\\n' in a, b'6\\n' in b\)",
)
_program(
    "output of a program that is not recorded",
    'float(subprocess.check_output(["printenv", "TRUTH_VALUE"]))',
    "warn",
    says=(r"not deterministic", r"subprocess|printenv"),
)


def _file(name: str, file: str, one: str, other: str, line: str, *top: str, says: str = "") -> None:
    """Register a class: a node reads a file of some format, with another value in it."""

    @fault(f"file: {name}")
    def planter(rng: random.Random) -> Planted:
        path = f'pathlib.Path(__file__).with_name("{file}")'
        read = line.format(path=path)
        a, node = _reads(rng, read, in_constructor=rng.random() < 0.5)
        node.top += top
        a.files[file] = one
        b = a.copy()
        b.files[file] = other
        words = rf"{LIKELY}{node.full_name} read {says or file}.* in a, .* in b\) at "
        return Planted(a, b, replace(_truth(node), first=(words,)))


_file(
    "JSON",
    "truth.json",
    '{"gain": 1.5}',
    '{"gain": 2.5}',
    'json.loads({path}.read_text())["gain"]',
    "import json",
)
_file(
    "YAML",
    "truth.yaml",
    "gain: 1.5\n",
    "gain: 2.5\n",
    'float(yaml.safe_load({path}.read_text())["gain"])',
    "import yaml",
)
_file(
    "table",
    "truth.csv",
    "t,gain\n0,1.5\n",
    "t,gain\n0,2.5\n",
    'float(first_row({path})["gain"])',
    "import csv",
    "def first_row(path):",
    "    with open(path) as file:",
    "        return next(csv.DictReader(file))",
)
_file(
    "array of numbers",
    "truth.dat",
    "1.5 2.0\n",
    "2.5 2.0\n",
    "float(np.loadtxt({path})[0])",
    "import numpy as np",
)
_file("left open", LEFT_OPEN, "1.5\n", "2.5\n", "float(open({path}).read())")
_file("size", "truth.bin", "123", "12345", "float({path}.stat().st_size)")
_file("as bytes", "truth.bin", "a", "b", "float({path}.read_bytes()[0])")
_file("seed", "truth.txt", "5", "6", "random.Random(int({path}.read_text())).random()")


@fault("file that one run does not find")
def not_found(rng: random.Random) -> Planted:
    line = 'float(pathlib.Path(__file__).with_name("truth.txt").read_text())'
    a, node = _reads(rng, line, in_constructor=False)
    a.files["truth.txt"] = "1.5\n"
    b = a.copy()
    del b.files["truth.txt"]
    b.folder = "elsewhere"
    first = (r"raised an exception only in b: FileNotFoundError: .*truth\.txt",)
    return Planted(a, b, Truth(("exception",), node.full_name, first=first, independent=None))


@fault("working folder")
def working_folder(rng: random.Random) -> Planted:
    a, node = _reads(rng, "float(len(os.path.basename(os.getcwd())))", in_constructor=False)
    a.working_folder = "short"
    b = a.copy()
    b.working_folder = "much_longer"
    return Planted(a, b, replace(_truth(node), first=(rf"{LIKELY}.*getcwd",)))


@fault("seed from the environment")
def seed(rng: random.Random) -> Planted:
    a, node = _reads(rng, "self.drawn.random()", in_constructor=False)
    node.setup.append('self.drawn = random.Random(int(os.getenv("TRUTH_SEED")))')
    a.environment["TRUTH_SEED"] = "1"
    b = a.copy()
    b.environment["TRUTH_SEED"] = "2"
    first = (rf"{LIKELY}{node.full_name} read TRUTH_SEED \(1 in a, 2 in b\)",)
    return Planted(a, b, replace(_truth(node), first=first))
