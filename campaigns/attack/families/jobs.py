"""Jobs from a grammar of mistakes: what people mistype, and what somebody would make up."""

from __future__ import annotations

import copy
import json
import os
from random import Random
from typing import Any

from campaigns.attack import hostile, oracle
from campaigns.attack.corpus import Corpus, put_robot
from campaigns.attack.families.common import Family
from campaigns.attack.model import Case, Command, Limits

GOOD: dict[str, Any] = {
    "nodes": [
        {"node": "robot:Driver", "name": "driver", "parameters": {"period": 0.01}},
        {"node": "robot:Arm", "remappings": {"ticks": "/ticks"}, "namespace": "/r"},
    ],
    "search_path": ["."],
    "start": "0s",
    "stop": {"duration": "100ms", "events": 1000},
    "seed": 7,
    "livelock_limit": 1000,
    "record": {"exclude": ["/camera/*"], "segment_events": 64},
    "guard": {"clock": "virtual", "thread": "warn"},
    "delay": {"default": "1ms", "topics": {"/ticks": {"uniform": {"min": 0, "max": "5ms"}}}},
    "policy": "fifo",
    "hooks": {},
}
_LIMITS = Limits(cpu_s=10, rss_mib=700)


def _ask(rng: Random, case: Case, text: str | bytes, name: str = "job.yaml") -> None:
    """Have every command read the job that reads jobs. None may run what is not the robot."""
    put_robot(case.folder)
    place = case.folder / name
    place.write_bytes(text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text)
    hostile.canary_module(case.folder / "elsewhere", case.canary)
    case.names = (name, name.encode("unicode_escape").decode(), "--until")
    _commands(rng, case, name)


def _commands(rng: Random, case: Case, name: str) -> None:
    case.user_code = False
    folder = case.folder
    read = Command(
        ("record", name, "--print-job", "--no-pin"), oracle.READING, folder, limits=_LIMITS
    )
    checks = [
        Command(("check", name), frozenset((0, 1, 2, 3)), folder, limits=_LIMITS),
        Command(("audit", name), frozenset((0, 1, 2)), folder, limits=_LIMITS),
        Command(
            ("record", name, "--no-pin", "--quiet", "--until", "0.05", "-o", "run.mcap", "--force"),
            oracle.RECORDING,
            folder,
            limits=_LIMITS,
        ),
    ]
    case.commands += [read, *(rng.sample(checks, rng.choice((1, 1, 3))))]


def _dumped(job: object) -> str:
    """JSON is YAML."""
    return json.dumps(job, indent=1, ensure_ascii=False)


def _places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path] if path else []
    if isinstance(value, dict):
        for key, below in value.items():
            found += _places(below, (*path, key))
    elif isinstance(value, list):
        for nth, below in enumerate(value):
            found += _places(below, (*path, nth))
    return found


def _mistyped(rng: Random, word: str) -> str:
    at = rng.randrange(len(word))
    return rng.choice(
        (
            word[:at] + word[at + 1 :],
            word[:at] + rng.choice("abcxyz_ -é") + word[at:],
            word.upper(),
            word + "s",
            word.replace("_", "-"),
            " " + word,
            word[::-1],
        )
    )


def _keys(rng: Random, case: Case, corpus: Corpus) -> None:
    job = copy.deepcopy(GOOD)
    for _ in range(rng.choice((1, 1, 2, 4))):
        path = rng.choice([p for p in _places(job) if isinstance(p[-1], str)])
        at = _at(job, path[:-1])
        at[_mistyped(rng, path[-1])] = at.pop(path[-1])
    _ask(rng, case, _dumped(job))


def _at(job: Any, path: tuple[Any, ...]) -> Any:
    for step in path:
        job = job[step]
    return job


_VALUES: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1.5,
    10**400,
    -(10**30),
    float("nan"),
    float("inf"),
    1e308,
    "",
    "x",
    "5 parsecs",
    "-5ms",
    "1e999s",
    "9" * 5000 + "s",
    "5m s",
    "٣s",
    "0x10",
    [],
    {},
    [[]],
    [None],
    {"": ""},
    {"a": {"b": {"c": {}}}},
    ["x"] * 10_000,
    {str(i): i for i in range(5000)},
    "$(env HOME)",
    "$(var x)",
    "$(" * 5000,
    "$(find-pkg-share nowhere)",
    "$(command touch canary)",
    "$(eval __import__('os').system('touch canary'))",
    "$(env $(env $(env HOME)))",
    "../" * 50 + "etc/passwd",
    "/dev/zero",
    "/proc/self/mem",
    "robot:Driver:x",
    "robot",
    ":",
    "os:system",
    "a b:c d",
    "..:x",
    "*" * 1000 + "[",
    "[" * 1000,
)


def _types(rng: Random, case: Case, corpus: Corpus) -> None:
    job = copy.deepcopy(GOOD)
    for _ in range(rng.choice((1, 1, 1, 3))):
        path = rng.choice(_places(job))
        _at(job, path[:-1])[path[-1]] = rng.choice(_VALUES)
    _ask(rng, case, _dumped(job).replace("NaN", ".nan").replace("Infinity", ".inf"))
    case.user_code = True  # a node may not take the value as its parameter


def _unknown_texts(rng: Random, case: Case, corpus: Corpus) -> None:
    job = copy.deepcopy(GOOD)
    text = rng.choice(hostile.texts(case.canary))
    path = rng.choice(_places(job))
    if rng.random() < 0.5 and isinstance(path[-1], str):
        at = _at(job, path[:-1])
        at[text] = at.pop(path[-1])
    else:
        _at(job, path[:-1])[path[-1]] = text
    raw = (
        _dumped(job)
        if rng.random() < 0.7
        else _dumped(job).encode().decode("unicode_escape", "replace")
    )
    _ask(rng, case, raw)
    case.user_code = True  # a node may not take the text as its parameter


def _nesting(rng: Random, case: Case, corpus: Corpus) -> None:
    depth = rng.choice((50, 500, 5000, 100_000))
    opening, closing = rng.choice(
        (("[", "]"), ("{a: ", "}"), ("- ", ""), ("a:\n ", ""), ("? ", ""))
    )
    body = opening * depth + "x" + closing * rng.choice((0, depth))
    _ask(rng, case, rng.choice(("", "nodes: ", "x-a: ", "delay: ")) + body)


def _laughs(rng: Random, case: Case, corpus: Corpus) -> None:
    depth, width = rng.choice(((9, 9), (30, 2), (5, 50), (3, 3)))
    kind = rng.choice(("list", "map", "merge"))
    lines = ["x-0: &a0 " + ("[lol]" if kind == "list" else "{k: lol}")]
    for i in range(1, depth):
        if kind == "list":
            value = "[" + ", ".join([f"*a{i - 1}"] * width) + "]"
        elif kind == "map":
            value = "{" + ", ".join(f"k{j}: *a{i - 1}" for j in range(width)) + "}"
        else:
            value = "{<<: [" + ", ".join([f"*a{i - 1}"] * width) + f"], k{i}: *a{i - 1}}}"
        lines.append(f"x-{i}: &a{i} {value}")
    where = rng.choice(("x-end", "nodes", "record", "delay", "seed"))
    lines.append(f"{where}: *a{depth - 1}")
    _ask(rng, case, "\n".join(lines) + "\n")


def _anchors(rng: Random, case: Case, corpus: Corpus) -> None:
    text = rng.choice(
        (
            "x-a: &a [*a]\nnodes: *a\n",
            "x-a: &a {<<: *a}\nnodes: []\n",
            "x-a: &a {b: &b {c: *a}, d: *b}\nnodes: *b\n",
            "nodes: &n\n- *n\n",
            "nodes: *nowhere\n",
            "x: &a x\nx: &a y\nnodes: []\n",
            "? [a, b]\n: c\nnodes: []\n",
            "? {a: b}\n: c\n",
            "<<: [1, 2]\nnodes: []\n",
            "<<: {<<: {<<: 5}}\n",
            "nodes: []\nnodes: []\n",
            "1: 2\nnull: 3\ntrue: 4\n2024-01-01: 5\n",
        )
    )
    _ask(rng, case, text)


def _tags(rng: Random, case: Case, corpus: Corpus) -> None:
    code = f"open({str(case.canary)!r},'w').write('tag')"
    text = rng.choice(
        (
            f"nodes: !!python/object/apply:eval [{json.dumps(code)}]\n",
            f"nodes: !!python/object/apply:os.system ['echo tag > {case.canary}']\n",
            "nodes: !!python/name:os.system\n",
            "!!python/object/new:type\n  args: [x, !!python/tuple [], {}]\n"
            f"  state: {json.dumps(code)}\n",
            "nodes: !!binary |\n  R0lGODlhDAAMAIQAAP\n",
            "seed: !!int '7'\nnodes: []\n",
            "seed: !!float nan\nnodes: []\n",
            "nodes: !<tag:x,2000:y> []\n",
            "%YAML 9.9\n---\nnodes: []\n",
            "%TAG ! tag:x:\n---\nnodes: !a []\n",
            "nodes: !!set {a, b}\n",
            "start: 2001-12-14t21:59:43.10-05:00\nnodes: []\n",
            "seed: 1:30:00\nnodes: []\n",
            "seed: 0b1010_0111\nnodes: []\n",
        )
    )
    _ask(rng, case, text)


def _bytes(rng: Random, case: Case, corpus: Corpus) -> None:
    good = _dumped(GOOD).encode()
    at = rng.randrange(len(good))
    text = rng.choice(
        (
            b"",
            b"\0",
            b"\xff\xfe",
            b"\xef\xbb\xbf" + good,
            good.decode().encode("utf-16"),
            good.decode().encode("utf-32"),
            good[:at],
            good[:at]
            + rng.choice((b"\0", b"\xff", b"\x1b[31m", b"\t", b"\r", b"\xe2\x80\xa8"))
            + good[at:],
            good.replace(b"\n", b"\r\n"),
            good.replace(b" ", b"\t"),
            b"---\n" + good + b"\n---\n" + good,
            b"...\n" * 1000,
            b"# " + b"x" * 3_000_000,
            b'nodes: "' + b"x" * 1_000_000,
            b"nodes: |\n" + b" x\n" * 100_000,
            b"k" * 2000 + b": 1\n",
            b": " * 10_000,
            b"- " * 10_000,
            b"!" * 10_000,
            b"&" * 1000,
            b"\x1b]0;owned\x07: 1\n",
            b"7\n",
            b"text\n",
            b"null\n",
        )
    )
    _ask(rng, case, text)


def _files(rng: Random, case: Case, corpus: Corpus) -> None:
    """Files that a job names and that are none: pipes, devices, folders, itself, too large."""
    folder = case.folder
    os.mkfifo(folder / "pipe")
    (folder / "dir.yaml").mkdir()
    (folder / "circle.yaml").write_text("base: circle2.yaml\n")
    (folder / "circle2.yaml").write_text("base: circle.yaml\n")
    (folder / "link.yaml").symlink_to("link.yaml")
    (folder / "sparse.yaml").write_bytes(b"nodes: []\n")
    os.truncate(folder / "sparse.yaml", 300 << 20)
    (folder / "bad.yaml").write_text("nodes: [\x1b[31m{{{\n")
    name = rng.choice(
        "pipe dir.yaml circle.yaml link.yaml sparse.yaml bad.yaml /dev/zero /dev/full /dev/tty "
        "nowhere.yaml /proc/self/environ . /etc/shadow ~ *.yaml job.yaml".split()
    )
    key = rng.choice(
        ("base", "include", "params", "delay", "launch", "bags", "main", "self", "ros", "policy")
    )
    job: dict[str, Any] = copy.deepcopy(GOOD)
    case.names = (name,)
    if key == "base":
        job["base"] = name
    elif key == "include":
        job["include"] = [name]
    elif key == "params":
        job["nodes"][0]["parameter_files"] = [name]
    elif key == "ros":
        job["ros_arguments"] = ["--params-file", name]
    elif key == "delay":
        job["delay"] = {
            "topics": {
                "/ticks": rng.choice(({"samples": {"file": name}}, {"series": {"file": name}}))
            }
        }
    elif key == "launch":
        job["launch"] = [name]
    elif key == "bags":
        job["bags"] = [name]
    elif key == "policy":
        job["policy"] = {"recorded": name}
    elif key == "main":
        job["nodes"].append({"main": name, "name": "x"})
    names = case.names
    _ask(rng, case, _dumped(job))
    case.names = (*case.names, *names)
    if key == "self" and name not in (".", "*.yaml"):
        case.commands.clear()
        _commands(rng, case, name)


def _shouts(rng: Random, case: Case, corpus: Corpus) -> None:
    """What the command line adds: --set with everything, --ros-args, --until."""
    _ask(rng, case, _dumped(GOOD))
    case.names = (*case.names, "--set", "--until", "--seed", "--ros-args", "Error", "error")
    case.user_code = True  # a node may not take the value as its parameter
    key = rng.choice(
        (
            "stop.duration",
            "nodes.driver.parameters.period",
            "nodes.99.node",
            "..",
            "",
            "nodes.+",
            "seed",
            "x.y.z",
            "nodes.'a",
            "launch.+",
            "[0]",
            "stop",
        )
    )
    value = rng.choice(
        (
            *hostile.texts(case.canary),
            "[" * 5000,
            "{",
            "null",
            "&a [*a]",
            "9" * 5000,
            "!!python/name:os.system",
        )
    )
    value = value.replace("\0", "")[:100_000]
    extra = rng.choice(
        (
            ("--set", f"{key}={value}"),
            ("--until", value),
            ("--ros-args", "-p", value, "-r", value),
            ("--seed", value),
        )
    )
    case.commands = [
        Command((*command.words, *extra), command.allowed, command.cwd, limits=command.limits)
        for command in case.commands
        if command.words[0] != "audit"
    ]
    if extra[0] in ("--until", "--seed"):
        case.commands = [c for c in case.commands if c.words[0] == "record"]


def _canaries(rng: Random, case: Case, corpus: Corpus) -> None:
    """Reading a job runs nothing: nodes are named here whose modules tell when they are run."""
    job: dict[str, Any] = copy.deepcopy(GOOD)
    job["search_path"] = ["elsewhere"]
    job["nodes"] = [{"main": "canary_nodes:main", "name": "x"}, {"node": "canary_nodes:hit"}]
    job["hooks"] = {"after": "canary_nodes:hit"}
    _ask(rng, case, _dumped(job))
    folder = case.folder
    (folder / "elsewhere" / "conftest.py").write_text(
        (folder / "elsewhere" / "canary_nodes.py").read_text()
    )
    case.names = (*case.names, "canary_nodes")
    case.commands = [
        Command(("record", "job.yaml", "--print-job", "--no-pin"), oracle.READING, folder),
        Command(("audit", "job.yaml"), frozenset((0, 1, 2)), folder),
        Command(("audit", "elsewhere"), frozenset((0, 1, 2)), folder),
        Command(("schema",), frozenset((0,)), folder),
        Command(
            ("init", "new.yaml", "--from", "elsewhere/canary_nodes.py:Node"), oracle.READING, folder
        ),
    ]


FAMILY = Family(
    "jobs",
    {
        "keys": _keys,
        "types": _types,
        "texts": _unknown_texts,
        "nesting": _nesting,
        "laughs": _laughs,
        "anchors": _anchors,
        "tags": _tags,
        "bytes": _bytes,
        "files": _files,
        "command-line": _shouts,
        "canaries": _canaries,
    },
    ros=True,
)
